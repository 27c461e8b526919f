"""`make test` holds beside packages of strangers: no test looks at what is theirs, and what counts all of ours counts
ours alone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from neighbours import ROOT, put_neighbours

pytestmark = pytest.mark.pipeline

COUNTING = [
    "tests/test_catalogue.py", "tests/test_completion.py", "tests/test_hook_docs.py", "tests/test_method_pages.py",
    "tests/test_protocol_page.py", "tests/test_golden_files.py::test_every_method_of_the_workspace_has_golden_files",
    "tests/test_wrong_input.py::test_there_are_rows_for_every_command",
    "plugins/sw-codecs/tests/test_conformance.py::test_every_coder_says_what_it_codes",
    "plugins/sw-datasets/tests/test_registry.py::test_the_registry_is_read_without_torch",
]  # fmt: skip
"""Tests that go over everything which is installed."""
ASKING = re.compile(r"load_plugins|command_entries|entry_points|is_ours")


def run_pytest(folder: Path, *arguments: str) -> str:
    """Run tests of this repository with the neighbours installed; return what pytest prints."""
    path = os.pathsep.join([*map(str, put_neighbours(folder)), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *arguments],
        cwd=ROOT, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=1200,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    return done.stdout


def test_the_neighbours_are_there(tmp_path):
    """Else what follows would say nothing."""
    path = os.pathsep.join([*map(str, put_neighbours(tmp_path)), *filter(None, sys.path)])
    program = "from splatwizard_core.plugins import load_plugins as l; print(*l().methods.names, len(l().broken))"
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    assert {"neighbour-methods", "opacity-prune"} < set(done.stdout.split())
    assert done.stdout.split()[-1] == "0"


def test_no_test_is_made_for_what_is_theirs(tmp_path):
    """Of files that can ask what is installed: the others name what they go over."""
    folders = [ROOT / "tests", *ROOT.glob("splatwizard-*/tests"), *ROOT.glob("plugins/*/tests")]
    tests = [path for folder in folders for path in sorted(folder.rglob("test_*.py"))]
    asking = [str(path) for path in tests if ASKING.search(path.read_text("utf-8"))]
    assert len(asking) > 50
    collected = run_pytest(tmp_path, "--collect-only", *asking)
    assert "test_conformance.py::test_gaussian_codecs" in collected
    assert [line for line in collected.splitlines() if "neighbour-" in line] == []


def test_what_counts_all_of_ours_counts_ours_alone(tmp_path):
    assert " passed" in run_pytest(tmp_path, *COUNTING)
