"""Our own packages keep the contracts, by the checks that strangers run."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
from sw_kit.checks.registration import MOST_LINES
from sw_kit.names import _ours
from sw_kit.suite import checks_of

from splatwizard_core.tooling import load_plugins

OURS = {info.distribution: info.module for info in load_plugins().plugins if info.distribution in _ours()}
REGISTER_EACH = """
import sys
from sw_kit.checks import registration_child

register = registration_child.register
registration_child.register = lambda names: [register(name) for name in names.split()]
registration_child.main(sys.argv[1])
"""


def test_all_register_silently_without_torch_in_few_lines():
    """By less than what `sw check-plugin` allows for one: 4,000 a package."""
    command = [sys.executable, "-c", REGISTER_EACH, " ".join(OURS.values())]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=300)
    assert done.stderr == ""
    found = json.loads(done.stdout)
    assert found["torch"] is False
    assert 1_000 * len(OURS) < found["lines"] < 5_000 * len(OURS) + MOST_LINES / 2
    assert found["torch"] is False


@pytest.mark.parametrize("distribution", OURS)
def test_registration_fields_and_signatures(distribution):
    checks = [check for check in checks_of(distribution, quick=True) if check.name != "registers lightly"]
    assert len(checks) >= 4
    findings = [check.finding() for check in checks]
    assert [finding for finding in findings if finding.state == "broken"] == []
    # A rasterizer that needs a GPU, a coder that is not installed, a program that nobody names.
    unchecked = [finding.detail for finding in findings if finding.state == "missing"]
    expected = ("cuda alone", "not installed", "needs MPEG's program")
    assert [detail for detail in unchecked if not any(words in detail for words in expected)] == []


@pytest.mark.slow
@pytest.mark.parametrize("distribution", OURS)
def test_the_whole_check(distribution):
    broken = [finding for check in checks_of(distribution) if (finding := check.finding()).state == "broken"]
    assert broken == []
