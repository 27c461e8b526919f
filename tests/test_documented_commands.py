"""Every command that README.md and docs/guide.md show runs as written.

A training command gets settings for some 20 steps added, so that the pages can be run in a test; `path/to/garden` and
`path/to/data` become a small photographed scene and a folder of data sets, and `demo` is drawn as small as `demo:tiny`.
A run of several methods becomes one of each, since those settings are not those of all; one of all rate points becomes
one of two. `sw doctor` is left to its own tests. Nothing else is changed.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from sw_datasets.demo.synthetic import SIZES

from splatwizard_core.cli.main import main

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "tools"))
from first_minutes import commands  # noqa: E402

SHORT: dict[str | None, list[str]] = {
    None: ["iterations=20"],
    "chimerags": ["distill.iterations=20", "pretrained.iterations=20"],
    "lightgaussian": ["prune.iterations=20", "pretrained.iterations=20"],
}
"""What makes a training short: of every method, and of one beside that."""
TRAINING = ("run", "train")
SMALL_DEMO = """
from sw_datasets.demo.synthetic import SIZES

SIZES["demo"] = SIZES["tiny"]
"""
"""A plugin for the processes that a run starts: drawing `demo` would be most of their work."""


def sw_arguments(command: str) -> list[str] | None:
    """What follows `sw` in the command, None if it is another program's."""
    words = shlex.split(command)
    return words[1:] if words[0] in ("sw", ".venv/bin/sw") else None


def short(arguments: list[str]) -> list[list[str]]:
    """The same for some 20 steps, method by method."""
    arguments = ["r1,r3" if word == "all" else word for word in arguments]
    if "--method" not in arguments:
        return [[*arguments, *_set(SHORT[None])]]
    at = arguments.index("--method") + 1
    return [
        [*arguments[:at], method, *arguments[at + 1 :], *_set([*SHORT[None], *SHORT.get(method, [])])]
        for method in arguments[at].split(",")
    ]


def _set(settings: list[str]) -> list[str]:
    return [word for setting in settings for word in ("--set", setting)]


@pytest.fixture(scope="module")
def working_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small photographed scene at path/to/garden and a root of data sets at path/to/data."""
    folder = tmp_path_factory.mktemp("documented")
    garden = folder / "path" / "to" / "garden"
    garden.parent.mkdir(parents=True)
    assert main(["data", "synth", str(garden), "--size", "tiny"]) == 0
    (folder / "path" / "to" / "data").mkdir()
    return folder


@pytest.fixture
def small_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`demo` has the pictures and points of `demo:tiny`, here and in every process started from here."""
    monkeypatch.setitem(SIZES, "demo", SIZES["tiny"])
    information = tmp_path / "sw_small_demo-1.0.dist-info"
    information.mkdir()
    (tmp_path / "sw_small_demo.py").write_text(SMALL_DEMO)
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: sw-small-demo\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text("[splatwizard]\nsmall-demo = sw_small_demo\n")
    paths = [str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))


def documented(page: str) -> list[str]:
    shown = [command for command in commands(ROOT / page) if sw_arguments(command) is not None]
    assert len(shown) >= 4, f"{page} shows hardly any command: has its layout changed?"
    return shown


@pytest.mark.parametrize("page", ["README.md", "docs/guide.md"])
def test_every_sw_command_of_the_page_succeeds_in_the_order_of_the_page(
    page: str, working_directory: Path, small_demo, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(working_directory)
    monkeypatch.setenv("SPLATWIZARD_DATA", str(working_directory / "path" / "to" / "data"))
    shutil.rmtree(working_directory / "out", ignore_errors=True)
    for command in documented(page):
        arguments = sw_arguments(command)
        assert arguments is not None
        if arguments == ["doctor"]:
            continue
        for words in short(arguments) if arguments[0] in TRAINING else [arguments]:
            status = main(words)
            assert status == 0, f"{page}: `{command}` ended with status {status}: {capsys.readouterr().err[-600:]}"


def test_the_make_targets_of_the_readme_exist() -> None:
    targets = [command.split()[1] for command in commands(ROOT / "README.md") if command.startswith("make ")]
    assert {"demo", "test"} <= set(targets)
    for target in targets:
        dry = subprocess.run(["make", "-n", target], cwd=ROOT, capture_output=True, text=True, check=False)
        assert dry.returncode == 0, dry.stderr


def test_the_python_scripts_of_the_pages_take_the_options_that_are_shown() -> None:
    for page in ("README.md", "docs/guide.md"):
        for command in commands(ROOT / page):
            words = shlex.split(command)
            if words[0].endswith("python") and words[1].endswith(".py"):
                script = ROOT / words[1]
                shown = subprocess.run(
                    [sys.executable, str(script), "--help"],
                    capture_output=True,
                    text=True,
                    check=False,
                    env={**os.environ, "COLUMNS": "200"},
                )
                assert shown.returncode == 0, shown.stderr
                for option in (word for word in words[2:] if word.startswith("--")):
                    assert option in shown.stdout, f"{page}: {words[1]} has no {option}"
