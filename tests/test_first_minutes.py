"""tools/first_minutes.py: what a newcomer pastes, how long it takes, what fails."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(ROOT / "tools"))
    return importlib.import_module("first_minutes")


def test_the_set_up_comes_first_and_everything_once(tool, tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "Text\n\n    sw run --set 'a=1'   # why\n    make demo  # sets up\n    make test\n"
        '    sw info x\n    sw info x\n    python benchmarks/one.py\n    the "tree\n    export A=1\n'
    )
    assert tool.first_steps([page]) == ["make demo", "sw run --set 'a=1'", "sw info x", "export A=1"]


def test_both_pages_have_their_commands(tool):
    steps = tool.first_steps(ROOT / page for page in tool.PAGES)
    assert steps[0] == tool.SETUP
    assert {"sw doctor", "sw run", "sw report out", ".venv/bin/sw schedule 3dgs"} <= set(steps)
    assert not [step for step in steps if "benchmarks" in step or "make test" in step]


def test_failures_are_told_and_variables_hold(tool, tmp_path):
    lines: list[str] = []
    steps = ["export PLACE=here", 'test "$PLACE" = here', "echo so; echo why; exit 3", "cat"]
    done = tool.paste(steps, tmp_path, {"PATH": "/usr/bin:/bin"}, 60, lines.append)
    assert [step.status for step in done] == [0, 0, 3, 0]  # nothing waits for input
    assert done[2].told == "why"
    assert [line.split()[-1] for line in lines] == ["PLACE=here", "here", "3", "why", "cat"]


def test_what_takes_too_long_is_stopped_and_the_rest_not_begun(tool, tmp_path):
    done = tool.paste(["sleep 100", "touch begun"], tmp_path, {"PATH": "/usr/bin:/bin"}, 0.2, lambda line: None)
    assert [step.status for step in done] == [None, None]
    assert not (tmp_path / "begun").exists()


def test_a_newcomer_has_no_environment_of_ours(tool, tmp_path, monkeypatch):
    old = tmp_path / "old" / "bin"
    old.mkdir(parents=True)
    (tmp_path / "old" / "pyvenv.cfg").touch()
    monkeypatch.setenv("PATH", f"{old}:/usr/bin")
    monkeypatch.setenv("PYTHONPATH", "somewhere")
    found = tool.newcomer(tmp_path, tmp_path / "clone")
    assert found["PATH"] == f"{tmp_path}/clone/.venv/bin:/usr/bin"
    assert "PYTHONPATH" not in found
    assert found["XDG_CACHE_HOME"] == str(tmp_path / "cache")
    assert sys.prefix not in found["PATH"]
