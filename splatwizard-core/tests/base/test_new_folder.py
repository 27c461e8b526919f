"""Folders that are whole or not there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from splatwizard_core.base.files import new_folder


def interrupted(path: Path) -> None:
    with new_folder(path) as folder:
        (folder / "half").write_text("half")
        raise KeyboardInterrupt


def overtaken(path: Path) -> None:
    with new_folder(path):
        path.mkdir()
        (path / "theirs").write_text("theirs")


def test_a_folder_appears_at_the_end_with_all_that_was_written(tmp_path: Path):
    with new_folder(tmp_path / "deep" / "out") as folder:
        (folder / "a").write_text("a")
        assert not (tmp_path / "deep" / "out").exists()
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["out"]
    assert (tmp_path / "deep" / "out" / "a").read_text() == "a"


def test_an_interrupted_folder_leaves_nothing(tmp_path: Path):
    with pytest.raises(KeyboardInterrupt):
        interrupted(tmp_path / "out")
    assert os.listdir(tmp_path) == []


def test_what_is_there_is_not_touched(tmp_path: Path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine").write_text("mine")
    with pytest.raises(FileExistsError), new_folder(tmp_path / "out"):
        pytest.fail("the block must not run")
    assert (tmp_path / "out" / "mine").read_text() == "mine"


def test_what_appeared_meanwhile_is_not_overwritten(tmp_path: Path):
    with pytest.raises(OSError):
        overtaken(tmp_path / "out")
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    assert (tmp_path / "out" / "theirs").read_text() == "theirs"


def test_what_a_killed_process_left_is_removed(tmp_path: Path):
    program = (
        "import os, sys\n"
        "from splatwizard_core.base.files import new_folder\n"
        "with new_folder(sys.argv[1]) as folder:\n"
        "    (folder / 'half').write_text('half')\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path / "out")], check=False, timeout=300)
    assert len(os.listdir(tmp_path)) == 1
    with new_folder(tmp_path / "out") as folder:
        (folder / "a").write_text("a")
    assert os.listdir(tmp_path) == ["out"]
