"""The page that a finished run leaves, and when it leaves none."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from sw_view import plugin
from sw_view.after_run import LONGEST_DECODE, MOST

from splatwizard_core.api import Scene, SceneError, SceneOptions
from splatwizard_core.tooling import FinishedRun, FinishedRuns, load_plugins, load_scene

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("demo:tiny", SceneOptions(), load_plugins())


def finish(
    folder: Path, open_scene: Callable[[], Scene], file: str = "3dgs_r3_v1.swz", decode_s: float = 0.1,
    complete: bool = False, **counts: int,
) -> tuple[Path, list[str]]:  # fmt: skip
    """Finish a run with this file: the page's path, and what was said."""
    shutil.copy(GOLDEN / file, folder / "scene.swz")
    record = SimpleNamespace(counts=counts or {"num_gaussians": 9}, codec=SimpleNamespace(decode_s=decode_s))
    said: list[str] = []
    run = FinishedRun(folder, record, open_scene)  # type: ignore[arg-type]
    plugin.run_finished(FinishedRuns([run], complete, None, said.append))
    return folder / "scene.html", said


def test_a_small_run_leaves_a_page_with_its_cameras(tmp_path, scene):
    page, said = finish(tmp_path, lambda: scene)
    text = page.read_text("utf-8")
    assert "view_000.png (test)" in text
    assert "<span>3dgs</span>" in text
    assert f"3dgs {tmp_path.name} on {scene.name}" in text
    assert said == []


def test_a_page_newer_than_its_file_stays_as_it_is(tmp_path, scene):
    page, _ = finish(tmp_path, lambda: scene)
    page.write_text("mine")
    os.utime(page, (2e9, 2e9))
    assert finish(tmp_path, lambda: scene)[0].read_text() == "mine"
    os.utime(page, (1e9, 1e9))  # an older run's
    assert finish(tmp_path, lambda: scene)[0].read_text("utf-8") != "mine"


@pytest.mark.parametrize(
    "why",
    [{"num_gaussians": MOST + 1}, {"num_gaussians": 0}, {"num_anchors": 9, "num_gaussians": 90}, {"complete": True},
     {"decode_s": LONGEST_DECODE + 1}],
    ids=str,
)  # fmt: skip
def test_no_page_is_made_of_what_is_large_slow_or_depends_on_the_camera(tmp_path, scene, why):
    page, said = finish(tmp_path, lambda: scene, **why)
    assert not page.exists()
    assert said == []


def test_a_page_that_cannot_be_made_is_told_in_a_line(tmp_path):
    def lost() -> Scene:
        raise SceneError("the pictures are gone")

    page, said = finish(tmp_path, lost)
    assert not page.exists()
    (line,) = said
    assert line.startswith(f"warning: {page} was not written: the pictures are gone")


def test_a_defect_of_the_page_fails_no_finished_run(tmp_path, scene, monkeypatch):
    def broken(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("sw_view.after_run.write_page", broken)
    page, (line,) = finish(tmp_path, lambda: scene)
    assert line.startswith(f"warning: {page} was not written: ZeroDivisionError: division by zero")
