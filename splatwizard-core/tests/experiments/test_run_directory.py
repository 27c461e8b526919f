"""Locks and finished steps of a run directory."""

import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from splatwizard_core.errors import RunLockedError
from splatwizard_core.experiments.lock import directory_lock
from splatwizard_core.experiments.steps import StepLog

HOLD = """
    import sys, time
    from pathlib import Path
    from splatwizard_core.experiments.lock import directory_lock
    with directory_lock(Path(sys.argv[1])):
        print("held", flush=True)
        time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path: Path):
    """Another process that holds the lock of tmp_path / "run"."""
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(HOLD), str(tmp_path / "run")], stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()


def test_a_locked_directory_is_refused_and_names_its_holder(tmp_path: Path, holder: subprocess.Popen[str]):
    with (
        pytest.raises(RunLockedError, match=rf"run is being written by process {holder.pid} on .+ since "),
        directory_lock(tmp_path / "run"),
    ):
        pass


def test_the_lock_of_a_killed_process_is_free(tmp_path: Path, holder: subprocess.Popen[str]):
    holder.kill()
    holder.wait()
    assert str(holder.pid) in (tmp_path / "run" / ".lock").read_text()  # it had no chance to clean up
    with directory_lock(tmp_path / "run"):
        assert json.loads((tmp_path / "run" / ".lock").read_text())["pid"] == os.getpid()


def test_waiting_says_for_whom_and_gets_the_lock(tmp_path: Path, holder: subprocess.Popen[str]):
    said: list[str] = []

    def tell(message: str) -> None:
        said.append(message)
        holder.kill()

    with directory_lock(tmp_path / "run", wait=True, on_wait=tell):
        pass
    assert len(said) == 1
    assert str(holder.pid) in said[0]


def test_one_process_cannot_lock_twice(tmp_path: Path):
    with directory_lock(tmp_path), pytest.raises(RunLockedError), directory_lock(tmp_path):
        pass
    with directory_lock(tmp_path):
        pass


def test_a_step_is_done_only_under_the_key_it_was_done_with(tmp_path: Path):
    StepLog(tmp_path).finish("train", "key", {"seconds": 1.5})
    again = StepLog(tmp_path)
    assert again.done("train", "key") == {"seconds": 1.5}
    assert again.done("train", "other") is None
    assert again.done("encode", "key") is None


@pytest.mark.parametrize("content", ["", "{", "[]", '{"train": 3}', '{"train": {"key": 1}}'])
def test_a_damaged_step_log_means_that_nothing_is_done(tmp_path: Path, content: str):
    (tmp_path / "steps.json").write_text(content)
    assert StepLog(tmp_path).done("train", "key") is None
