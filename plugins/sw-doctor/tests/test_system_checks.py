"""Findings of `sw doctor` about folders, disk, memory and Python."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections import namedtuple

from sw_doctor import system


def test_folders_that_can_be_written_are_left_as_they_were(tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "not" / "yet"))
    monkeypatch.chdir(tmp_path)
    assert system.check_cache().state == "ok"
    assert system.check_working_folder().state == "ok"
    assert list(tmp_path.iterdir()) == []


def test_a_cache_folder_that_a_file_stands_in_the_way_of_is_broken(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "file" / "cache"))
    found = system.check_cache()
    assert (found.state, found.needed) == ("broken", False)
    assert str(tmp_path) in found.detail
    assert "SPLATWIZARD_CACHE" in (found.mend or "")


def test_a_working_folder_that_refuses_files_stops_the_main_job(tmp_path, monkeypatch):
    def refuse(**_: object):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "NamedTemporaryFile", refuse)
    found = system.check_working_folder()
    assert (found.state, found.needed) == ("broken", True)
    assert "Permission denied" in found.detail


def test_a_disk_that_takes_no_byte_more_is_told_apart(tmp_path, monkeypatch):
    def refuse(**_: object):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "NamedTemporaryFile", refuse)
    found = system.check_working_folder()
    assert found.state == "missing"
    assert "no space left" in found.detail
    assert "free some space" in (found.mend or "")


def test_a_nearly_full_disk_is_missing_space(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9 - 10**6, 10**6))
    found = system.check_working_folder()
    assert found.state == "missing"
    assert "0.00 GB free" in found.detail


def test_the_limit_of_a_container_is_the_memory_there_is(monkeypatch):
    monkeypatch.setattr(system, "container_limit", lambda: 500_000_000)
    found = system.check_memory()
    assert (found.state, found.needed) == ("missing", True)
    assert found.facts["total_bytes"] == 500_000_000
    assert "limit of the container" in found.detail


def test_a_python_that_is_too_old_is_broken(monkeypatch):
    monkeypatch.setattr(system, "OLDEST_PYTHON", (99, 0))
    assert system.check_python().state == "broken"
