"""tools/install_packages.py: kernels are compiled before anything is installed."""

from __future__ import annotations

import importlib
import shutil
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
NATIVE = ROOT / "splatwizard-native"
POOL = "splatwizard_native.face_operations:POOL"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("install_packages")


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_kernels_need_the_sources_alone_and_two_builds_take_turns(tool, tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path))
    with tool.building([POOL], [NATIVE]), tool.building([POOL], [NATIVE]):
        pass
    assert len(list(tmp_path.glob("native/*.so"))) == 1
    (log,) = tmp_path.glob("native/*.log")
    assert log.read_text().count(" -shared ") == 1


def test_without_kernels_nothing_is_started(tool, monkeypatch):
    monkeypatch.setattr(tool.subprocess, "Popen", None)
    with tool.building([], [NATIVE]):
        pass


def test_an_environment_that_is_there_is_taken_and_half_of_one_is_made_whole(tool, tmp_path, monkeypatch):
    commands: list[list[str]] = []
    monkeypatch.setattr(tool.subprocess, "run", lambda command, **options: commands.append(command))
    python, pip = tmp_path / "bin" / "python", tmp_path / "bin" / "pip"
    python.parent.mkdir()
    python.touch()
    assert tool.environment(tmp_path) == str(python)
    assert [command[1:] for command in commands] == [["-m", "venv", str(tmp_path)]]
    pip.touch()
    assert tool.environment(tmp_path) == str(python)
    assert len(commands) == 1
