"""Workers that are forked when all is collected tell what pytest in one process would, and share the cores."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from forked_children import run_python

CONFTEST = """
import pytest
from forked_workers import run_forked

def pytest_runtestloop(session):
    run_forked(session, 2, 1)
    return True

@pytest.fixture(scope="session", autouse=True)
def whole(tmp_path_factory):
    yield
    (tmp_path_factory.getbasetemp() / "ended").touch()
"""
TESTS = """
import os, warnings
import pytest

@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    yield tmp_path_factory.mktemp("x")
    (tmp_path_factory.getbasetemp() / "torn").touch()

def test_passes(folder):
    assert "TEST_JOBS" not in os.environ
    warnings.warn("look here")

def test_fails(folder):
    print("what it printed")
    assert folder.parent.name == "nobody"

@pytest.mark.skip(reason="not today")
def test_skips():
    pass
"""
NEXT = """
import glob, os

def test_what_the_last_file_set_up_is_gone(tmp_path_factory):
    base = tmp_path_factory.getbasetemp()
    assert not (base / "x0").exists() or (base / "torn").exists()
    assert not (base / "ended").exists()
"""
PYTEST = "import sys, pytest; sys.exit(pytest.main(sys.argv[1:]))"
DIES = "import os\ndef test_dies(): os._exit(0)\n"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")


def ran(folder: Path, **files: str) -> subprocess.CompletedProcess[str]:
    for name, text in {"conftest": CONFTEST, **files}.items():
        (folder / f"{name}.py").write_text(text)
    command = ["-c", PYTEST, "-p", "no:cacheprovider", f"--basetemp={folder / 'base'}"]
    paths = os.pathsep.join(filter(None, [str(Path(__file__).parent), os.environ.get("PYTHONPATH")]))
    return run_python(*command, cwd=folder, env={**os.environ, "PYTHONPATH": paths, "TEST_JOBS": "2"})


def test_their_findings_are_reported_in_one_process(tmp_path):
    done = ran(tmp_path, test_a=TESTS, test_b=NEXT, test_c=NEXT)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "1 failed, 3 passed, 1 skipped, 1 warning in" in done.stdout
    assert "test_a.py::test_fails" in done.stdout
    assert "what it printed" in done.stdout
    assert "UserWarning: look here" in done.stdout
    assert (tmp_path / "base" / "worker-0" / "ended").exists()
    assert (tmp_path / "base" / "worker-1" / "ended").exists()


def test_one_that_dies_fails_the_session_by_the_name_of_its_test(tmp_path):
    done = ran(tmp_path, test_a=DIES)
    assert done.returncode not in (0, 1, 5)
    assert "has ended in test_a.py::test_dies" in done.stdout + done.stderr


def test_this_worker_has_its_share_of_the_cores():
    if "TEST_WORKER" not in os.environ:
        pytest.skip("the tests run in one process")
    assert torch.get_num_threads() == int(os.environ["OMP_NUM_THREADS"])
