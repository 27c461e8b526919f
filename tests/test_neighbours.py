"""`make test` holds beside packages of strangers: no test looks at what is theirs, and what counts all of ours counts
ours alone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from forked_children import run_python
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


COLLECTING = f"""
import sys, pytest

class Plugin:
    def pytest_collection_modifyitems(self, items):
        print(*(f"collected {{item.nodeid}}" for item in items), sep="\\n")
        items[:] = [item for item in items if item.nodeid.startswith({tuple(COUNTING)})]

sys.exit(pytest.main(sys.argv[1:], [Plugin()]))
"""
"""Program that tells every test it collects and runs those alone that go over everything."""


def run_pytest(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run tests of this repository with the neighbours installed."""
    path = os.pathsep.join([*map(str, put_neighbours(folder)), *filter(None, sys.path)])
    words = ["-q", "--assert=plain", "-p", "no:cacheprovider", *arguments]
    return run_python("-c", COLLECTING, *words, cwd=ROOT, env={**os.environ, "PYTHONPATH": path})


def test_the_neighbours_are_there(tmp_path):
    """Else what follows would say nothing."""
    path = os.pathsep.join([*map(str, put_neighbours(tmp_path)), *filter(None, sys.path)])
    program = "from splatwizard_core.plugins import load_plugins as l; print(*l().methods.names, len(l().broken))"
    done = run_python("-c", program, env={**os.environ, "PYTHONPATH": path}, check=True)
    assert {"neighbour-methods", "opacity-prune"} < set(done.stdout.split())
    assert done.stdout.split()[-1] == "0"


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> subprocess.CompletedProcess[str]:
    """Answer about the files that can ask what is installed; the others name what they go over."""
    folders = [ROOT / "tests", *ROOT.glob("splatwizard-*/tests"), *ROOT.glob("plugins/*/tests")]
    tests = [path for folder in folders for path in sorted(folder.rglob("test_*.py"))]
    asking = [str(path) for path in tests if ASKING.search(path.read_text("utf-8"))]
    assert len(asking) > 50
    counting = {str(ROOT / each.partition("::")[0]) for each in COUNTING}
    return run_pytest(tmp_path_factory.mktemp("beside"), *sorted({*asking, *counting}))


def test_no_test_is_made_for_what_is_theirs(ran):
    collected = [line for line in ran.stdout.splitlines() if line.startswith("collected ")]
    assert any("test_conformance.py::test_gaussian_codecs" in line for line in collected)
    assert [line for line in collected if "neighbour-" in line] == []


def test_what_counts_all_of_ours_counts_ours_alone(ran):
    assert ran.returncode == 0, ran.stdout[-4000:] + ran.stderr[-2000:]
    assert int(re.search(r"(\d+) passed", ran.stdout)[1]) >= len(COUNTING)
