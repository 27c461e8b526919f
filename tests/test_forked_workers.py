"""Workers that are forked when all is collected tell what pytest in one process would, and share the cores."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from forked_children import run_python
from forked_workers import needs_gpu

CONFTEST = """
import pytest
from forked_workers import run_forked

def pytest_runtestloop(session):
    return run_forked(session, 2, 1) or None

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
ON_GPU = """
import os, pytest

@pytest.mark.cuda
@pytest.mark.parametrize("i", range(2))
def test_it_is_not_forked(i):
    assert "TEST_WORKER" not in os.environ
    assert "TEST_JOBS" not in os.environ
"""
HAS_GPU = """
import torch
torch.cuda.{} = lambda: True

def pytest_configure(config):
    config.addinivalue_line("markers", "cuda")
"""
DIES = "import os\ndef test_dies(): os._exit(0)\n"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")


def ran(folder: Path, **files: str) -> subprocess.CompletedProcess[str]:
    for name, text in {"conftest": CONFTEST, **files}.items():
        (folder / f"{name}.py").write_text(text)
    command = ["-c", PYTEST, "-p", "no:cacheprovider", f"--basetemp={folder / 'base'}"]
    outside = {name: value for name, value in os.environ.items() if name != "TEST_WORKER"}
    paths = os.pathsep.join(filter(None, [str(Path(__file__).parent), os.environ.get("PYTHONPATH")]))
    return run_python(*command, cwd=folder, env={**outside, "PYTHONPATH": paths, "TEST_JOBS": "2"})


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


@pytest.mark.parametrize("told", ["is_available", "is_initialized"])
def test_tests_that_use_a_gpu_run_in_one_process(tmp_path, told):
    done = ran(tmp_path, conftest=CONFTEST + HAS_GPU.format(told), test_a=ON_GPU, test_b=ON_GPU)
    assert "4 passed" in done.stdout, done.stdout + done.stderr
    assert done.stdout.count("the tests run in one process: forked ones cannot use the GPU\n") == 1


def test_without_a_test_for_it_a_gpu_is_no_reason(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert not needs_gpu([SimpleNamespace(get_closest_marker={"slow": True}.get)])
    assert needs_gpu([SimpleNamespace(get_closest_marker={"cuda": True}.get)])


def test_this_worker_has_its_share_of_the_cores():
    if "TEST_WORKER" not in os.environ:
        pytest.skip("the tests run in one process")
    assert torch.get_num_threads() == int(os.environ["OMP_NUM_THREADS"])
