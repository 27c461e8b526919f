"""Our own packages keep the contracts, by the checks that strangers run."""

from __future__ import annotations

import pytest
from sw_kit.names import _ours
from sw_kit.suite import checks_of

from splatwizard_core.tooling import load_plugins

OURS = [info.distribution for info in load_plugins().plugins if info.distribution in _ours()]


@pytest.mark.parametrize("distribution", OURS)
def test_registration_fields_and_signatures(distribution):
    checks = checks_of(distribution, quick=True)
    assert len(checks) >= 5
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
