"""Files that are whole or not there, whatever goes wrong while they are written."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splatwizard_core.base import files
from splatwizard_core.base.files import (
    bytes_with_named,
    file_sha256,
    remove_folder,
    replacing,
    scratch_folder,
    sweep,
    write_atomic,
    write_json,
)
from splatwizard_core.errors import DiskFullError


def interrupted_write(path: Path) -> None:
    with replacing(path) as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt


def failed_write(path: Path, error: Exception) -> None:
    with replacing(path, wanted=12_345) as temporary:
        temporary.write_text("half")
        raise error


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
        "import os, signal, sys\nfrom splatwizard_core.base.files import replacing\n"
        "with replacing(sys.argv[1]) as t:\n    t.write_text('half')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(path)], check=False, timeout=300)
    (left,) = os.listdir(tmp_path)
    of_another = left.replace(".x.", ".y.")
    (tmp_path / of_another).write_text("half")
    with replacing(path) as outer:
        outer.write_text("outer")
        write_atomic(path, "inner")
        assert set(os.listdir(tmp_path)) == {"x", outer.name, of_another}
    assert path.read_text() == "outer"
    assert set(os.listdir(tmp_path)) == {"x", of_another}


def test_a_process_that_is_younger_than_a_file_did_not_begin_it(tmp_path: Path):
    """In a container every process may have the same number as the one that was killed."""
    ours, older = (tmp_path / f".x.{os.getpid()}-0123456{i}.tmp" for i in range(2))
    for file in (ours, older):
        file.write_text("half")
    os.utime(older, (0, 0))
    write_atomic(tmp_path / "x", "text")
    assert set(os.listdir(tmp_path)) == {"x", ours.name}


def test_a_sweep_takes_what_was_to_become_anything(tmp_path: Path):
    for name in (".a.json.1-01234567.tmp", ".b.2-01234567.tmp", "kept.tmp", ".kept", ".a.json.tmp"):
        (tmp_path / name).write_text("half")
        os.utime(tmp_path / name, (0, 0))
    (tmp_path / ".c.3-01234567.tmp").mkdir()
    (tmp_path / ".c.3-01234567.tmp" / "inside").write_text("half")
    os.utime(tmp_path / ".c.3-01234567.tmp", (0, 0))
    sweep(tmp_path)
    assert set(os.listdir(tmp_path)) == {"kept.tmp", ".kept", ".a.json.tmp"}
    sweep(tmp_path / "absent")


def test_a_scratch_folder_goes_and_takes_those_of_killed_processes_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    program = (
        "import os, signal, sys, tempfile\nfrom splatwizard_core.base.files import scratch_folder\n"
        "tempfile.tempdir = sys.argv[1]\n"
        "with scratch_folder('test') as f:\n    (f / 'x').touch()\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program, str(tmp_path)], check=False, timeout=300)
    assert len(os.listdir(tmp_path)) == 1
    with scratch_folder("test") as folder:
        assert os.listdir(tmp_path) == [folder.name]
        assert list(folder.iterdir()) == []
        (folder / "y").touch()
    assert os.listdir(tmp_path) == []


def test_a_folder_is_removed_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    folder = tmp_path / "x"
    folder.mkdir()
    (folder / "a").touch()

    def killed(path: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("shutil.rmtree", killed)
    with pytest.raises(KeyboardInterrupt):
        remove_folder(folder)
    assert not folder.exists()
    monkeypatch.undo()
    (left,) = tmp_path.iterdir()
    os.utime(left, (0, 0))
    sweep(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "the disk is full"),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), "the disk quota is used up"),
        (OSError(errno.EFBIG, "File too large"), "the file may not grow that large here"),
        (RuntimeError("I/O error: No space left on device (os error 28)"), "the disk is full"),
    ],
)
def test_a_full_disk_names_the_file_and_what_was_wanted(tmp_path: Path, error: Exception, reason: str):
    path = tmp_path / "x"
    path.write_text("before")
    with pytest.raises(DiskFullError) as told:
        failed_write(path, error)
    assert str(told.value).startswith(f"{path}: {reason}")
    assert "(12,345 bytes wanted" in str(told.value)
    assert told.value.__cause__ is error
    assert path.read_text() == "before"
    assert os.listdir(tmp_path) == ["x"]


@pytest.mark.parametrize("error", [OSError(errno.EIO, "Input/output error"), ValueError("os error 28")])
def test_other_errors_are_not_taken_for_a_full_disk(tmp_path: Path, error: Exception):
    with pytest.raises(type(error)) as told:
        failed_write(tmp_path / "x", error)
    assert told.value is error


def test_sha256_of_a_file(tmp_path: Path):
    (tmp_path / "abc").write_bytes(b"abc")
    # FIPS 180-2, example B.1
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert file_sha256(tmp_path / "abc") == expected


def test_temporaries_of_another_container_stay_for_a_day(tmp_path):
    """On a shared folder a number says nothing of a process in another PID namespace, however free it is here."""
    nobody = 2**22 + 1  # more than a number of a process may be
    theirs = [tmp_path / f".a.{nobody}-0000000{i}-12345678.tmp" for i in (1, 2)]
    ours = tmp_path / f".a.{nobody}-{files._numbering()}-12345678.tmp"
    for each in (*theirs, ours):
        each.write_text("half")
    long_ago = time.time() - 2 * files.FOREIGN_SECONDS
    os.utime(theirs[1], (long_ago, long_ago))
    files.sweep(tmp_path, "a")
    assert sorted(tmp_path.iterdir()) == [theirs[0]]


def test_a_description_counts_with_the_files_that_it_names(tmp_path: Path):
    (tmp_path / "sub").mkdir()
    for name, size in (("a.webp", 100), ("b.webp", 20), ("other.webp", 3000), ("sub/c.webp", 4000)):
        (tmp_path / name).write_bytes(bytes(size))
    names = [
        "a.webp",
        "b.webp",
        "a.webp",
        "sub",
        "sub/c.webp",
        "../x",
        "..",
        "gone.webp",
        "meta.json",
        "\x00",
        "\u4e2d" * 120,
    ]
    meta = tmp_path / "meta.json"
    meta.write_text(json.dumps({"means": {"files": names}}, ensure_ascii=False), "utf-8")
    assert bytes_with_named(meta) == meta.stat().st_size + 4120
    (tmp_path / "lod-meta.json").write_text(json.dumps({"filenames": ["meta.json", "./a.webp"]}), "utf-8")
    own = (tmp_path / "lod-meta.json").stat().st_size
    assert bytes_with_named(tmp_path / "lod-meta.json") == own + meta.stat().st_size + 4120
    assert bytes_with_named(tmp_path / "a.webp") == 100
    plain = meta.rename(tmp_path / "meta.swz")
    assert bytes_with_named(plain) == plain.stat().st_size
