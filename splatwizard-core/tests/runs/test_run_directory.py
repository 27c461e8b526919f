"""Locks and finished steps of a run directory."""

import contextlib
import errno
import fcntl
import json
import os
import subprocess
import sys
import textwrap
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatwizard_core.base import lock
from splatwizard_core.base.lock import directory_lock
from splatwizard_core.errors import RunLockedError, SceneError
from splatwizard_core.runs.directory import OWN_FILES, RunRequest, StepLog
from splatwizard_core.runs.facts import StepFacts
from splatwizard_core.runs.run import run
from splatwizard_core.runs.training import CACHE
from splatwizard_core.training.params import PipelineParams

HOLD = """
    import sys, time
    from pathlib import Path
    from splatwizard_core.base.lock import directory_lock
    with directory_lock(Path(sys.argv[1])):
        print("held", flush=True)
        time.sleep(3600)
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


def test_who_ended_without_letting_go_is_told_once(tmp_path: Path, holder: subprocess.Popen[str]):
    holder.kill()
    holder.wait()
    said: list[str] = []
    for _ in range(2):
        with directory_lock(tmp_path / "run", say=said.append):
            pass
    (line,) = said
    assert line.startswith(f"process {holder.pid} on ")
    assert "ended without finishing" in line


def test_the_holder_says_what_it_was_called_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["/somewhere/bin/sw", "run", "--scene", "my garden"])
    with (
        directory_lock(tmp_path),
        pytest.raises(RunLockedError, match=r"\(`sw run --scene 'my garden'`\): wait for it, or choose"),
        directory_lock(tmp_path),
    ):
        pass


def test_a_file_system_without_locks_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(RunLockedError, match=r"\.lock cannot be locked \(No locks"), directory_lock(tmp_path):
        pass


def test_a_link_in_the_place_of_the_lock_is_refused_and_its_target_stays(tmp_path: Path):
    target = tmp_path / "precious"
    target.write_text("all my work")
    (tmp_path / ".lock").symlink_to(target)
    with pytest.raises(RunLockedError, match=r"\.lock cannot be locked"), directory_lock(tmp_path):
        pass
    assert target.read_text() == "all my work"


@pytest.mark.parametrize("content", ["", "{", "[]", "null", '{"pid": "x"}', '{"pid": 3}', "\0\0"])
def test_a_lock_file_that_says_nothing_holds_nothing(tmp_path: Path, content: str):
    (tmp_path / ".lock").write_text(content)
    with directory_lock(tmp_path):
        pass


def test_waiting_says_for_whom_and_gets_the_lock(tmp_path: Path, holder: subprocess.Popen[str]):
    said: list[str] = []

    def tell(message: str) -> None:
        said.append(message)
        holder.kill()

    with directory_lock(tmp_path / "run", wait=True, say=tell):
        pass
    waited, ended = said
    assert waited.startswith("waiting: ")
    assert "ended without finishing" in ended
    assert all(str(holder.pid) in line for line in said)


def test_one_process_cannot_lock_twice(tmp_path: Path):
    with directory_lock(tmp_path), pytest.raises(RunLockedError), directory_lock(tmp_path):
        pass
    with directory_lock(tmp_path):
        pass


def test_a_step_is_done_only_under_the_key_it_was_done_with(tmp_path: Path):
    StepLog(tmp_path).finish("train", "key", StepFacts(contended={"train": 0.5}))
    again = StepLog(tmp_path)
    assert again.done("train", "key", StepFacts).contended == {"train": 0.5}
    assert again.done("train", "other", StepFacts) is None
    assert again.done("encode", "key", StepFacts) is None


WRONG = '{"train": {"key": "key", "facts": {"contended": 3}}}'


@pytest.mark.parametrize("content", ["", "{", "[]", '{"train": 3}', '{"train": {"key": 1}}', WRONG])
def test_a_damaged_step_log_means_that_nothing_is_done(tmp_path: Path, content: str):
    (tmp_path / "steps.json").write_text(content)
    assert StepLog(tmp_path).done("train", "key", StepFacts) is None


def test_the_page_about_run_directories_says_what_is():
    page = Path(__file__).resolve().parents[3] / "docs" / "runs.md"
    if not page.exists():
        pytest.skip("no docs here: the package is tested alone")
    text = page.read_text(encoding="utf-8")
    for name in (*OWN_FILES, lock.NAME, CACHE):
        assert name in text, name
    for step in ("train", "encode", "decode", "evaluate", "record"):
        assert f"\n| {step} |" in text
    assert f"`checkpoint_every`, {PipelineParams().checkpoint_every} steps" in text


def test_a_scene_that_no_record_can_name_is_refused_before_anything_is_written(tmp_path: Path):
    resolved = SimpleNamespace(absolute_scene=str(tmp_path / "caf\udce9"), method="toy", rate="r1")
    with pytest.raises(SceneError, match="is not UTF-8"):
        run(None, RunRequest(resolved, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    """In a shared folder another user may have laid it: what it points to must not be emptied."""
    (tmp_path / "precious").write_text("kept")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".lock").symlink_to(tmp_path / "precious")
    with contextlib.suppress(RunLockedError, OSError), directory_lock(tmp_path / "run"):
        pass
    assert (tmp_path / "precious").read_text() == "kept"
