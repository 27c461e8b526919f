"""A bare PATH and a folder of packages; this folder on the path too, where pytest's importlib mode puts none."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A PATH that leads to one folder, empty so far, and no variable that points to a compiler."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    for name in ("CXX", "CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    return folder


@pytest.fixture
def out_of_patience(monkeypatch: pytest.MonkeyPatch) -> Callable[[Path], None]:
    """out_of_patience(sign): let time limits of child processes be over once the file `sign` is there, not before.

    The clock that `subprocess` compares stands still until then, and for a few looks more: in between it reads what was
    told before the sign. It looks whenever the limit is over by the real clock.
    """

    def stand_still(sign: Path) -> None:
        looks = itertools.count()
        monkeypatch.setattr(subprocess, "_time", lambda: 1e9 if sign.exists() and next(looks) > 8 else 0.0)

    return stand_still


@pytest.fixture
def site(tmp_path, monkeypatch) -> Path:
    """A folder whose distributions count as installed, here and in child processes."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH")))))
    return folder
