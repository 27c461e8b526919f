"""Files that are whole or not there, whatever goes wrong while they are written."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from splatwizard_core.files import file_sha256, replacing, write_atomic, write_json


def interrupted_write(path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt


@pytest.mark.parametrize("content", ["text, ä\n", b"\x00\xff"])
def test_what_is_written_is_there_alone(tmp_path: Path, content: str | bytes):
    path = tmp_path / "x"
    path.write_bytes(b"something longer from before")
    write_atomic(path, content)
    assert path.read_bytes() == (content.encode() if isinstance(content, str) else content)
    assert os.listdir(tmp_path) == ["x"]


def test_a_failed_write_leaves_the_old_file_and_no_rubbish(tmp_path: Path):
    path = tmp_path / "x.json"
    write_json(path, {"a": 1})
    with pytest.raises(ValueError, match="JSON"):
        write_json(path, {"a": float("nan")})
    with pytest.raises(UnicodeEncodeError):
        write_atomic(path, "\udc80")
    with pytest.raises(KeyboardInterrupt):
        interrupted_write(path)
    assert json.loads(path.read_text()) == {"a": 1}
    assert os.listdir(tmp_path) == ["x.json"]


def test_the_old_file_stands_until_the_new_one_is_whole(tmp_path: Path):
    path = tmp_path / "x"
    path.write_text("old")
    with replacing(path) as temporary:
        temporary.write_text("new")
        assert temporary.parent == path.parent
        assert path.read_text() == "old"
    assert path.read_text() == "new"


def test_a_folder_that_is_not_there_is_the_systems_error(tmp_path: Path):
    with pytest.raises(FileNotFoundError):
        write_atomic(tmp_path / "absent" / "x", "text")


def test_what_a_killed_process_left_goes_with_the_next_write(tmp_path: Path):
    """Only of that file, and not what a running process is writing."""
    path = tmp_path / "x"
    program = (
        "import os, signal, sys\nfrom splatwizard_core.files import replacing\n"
        "with replacing(sys.argv[1]) as t:\n    t.write_text('half')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=False, timeout=60)
    (left,) = os.listdir(tmp_path)
    of_another = left.replace(".x.", ".y.")
    (tmp_path / of_another).write_text("half")
    with replacing(path) as outer:
        outer.write_text("outer")
        write_atomic(path, "inner")
        assert set(os.listdir(tmp_path)) == {"x", outer.name, of_another}
    assert path.read_text() == "outer"
    assert set(os.listdir(tmp_path)) == {"x", of_another}


def test_sha256_of_a_file(tmp_path: Path):
    (tmp_path / "abc").write_bytes(b"abc")
    # FIPS 180-2, example B.1
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert file_sha256(tmp_path / "abc") == expected
