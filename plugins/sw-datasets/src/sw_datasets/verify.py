"""Checks that a scene on disk is whole: it loads, its pictures are readable, its files are those that were unpacked."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatwizard_core.api import PluginManager, Scene, SceneError, SceneOptions, SplatwizardError, View, track
from splatwizard_core.tooling import file_sha256, load_scene
from sw_datasets.picture_names import find_pictures, is_inside
from sw_datasets.pictures import picture_header

MAX_PROBLEMS = 5
"""Of one kind; more are counted."""


@dataclass
class Verdict:
    """Result of checking one scene.

    cameras     different intrinsics
    pictures    picture folder -> pictures whose header was read
    recorded    files that were held against what `sw data fetch` noted; None: it noted nothing
    problems    what is wrong, one line each; empty: the scene is whole
    warnings    what the loader says besides
    """

    name: str
    path: str
    train: int = 0
    test: int = 0
    cameras: int = 0
    points: int | None = None
    pictures: dict[str, int] = field(default_factory=dict)
    recorded: int | None = None
    problems: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def is_whole(self) -> bool:
        return not self.problems


def verify_scene(
    name: str,
    path: Path,
    plugins: PluginManager,
    *,
    family: str | None = None,
    needs: Sequence[str] = (),
    views: tuple[int, int] | None = None,
    recorded: Mapping[str, Any] | None = None,
    checksums: bool = False,
    decode: bool = False,
) -> Verdict:
    """Check one scene folder; faults stand in the verdict and are never raised.

    family      dataset family that reads it; None: whichever recognises it
    needs       files and folders that must be there
    views       (train, test) views that it must have
    recorded    path in the scene -> [bytes, SHA-256], as `sw data fetch` noted them
    checksums   compare the SHA-256 of each recorded file too, not its size alone
    decode      decode every picture, not its header alone
    """
    verdict = Verdict(name, str(path))
    verdict.problems += [f"{need} is missing" for need in needs if not (path / need).exists()]
    if recorded is not None:
        verdict.recorded = len(recorded)
        verdict.problems += _changed(path, recorded, checksums=checksums)
    known = family is not None and family in plugins.datasets
    try:
        scene = load_scene(f"{family}:{path}" if known else str(path), SceneOptions(), plugins)
    except SplatwizardError as error:
        verdict.problems.append(str(error))
        return verdict
    except OSError as error:
        verdict.problems.append(f"{error.filename or path}: {error.strerror or error}")
        return verdict
    all_views = list({id(view): view for view in scene.train + scene.test}.values())
    verdict.train, verdict.test = len(scene.train), len(scene.test)
    intrinsics = {(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in (view.camera for view in all_views)}
    verdict.cameras = len(intrinsics)
    verdict.points = None if scene.points is None else len(scene.points)
    verdict.warnings += scene.warnings
    if views is not None and views != (verdict.train, verdict.test):
        verdict.problems.append(
            f"{verdict.train} train and {verdict.test} test views, it should have {views[0]} and {views[1]}"
        )
    folder = scene.protocol.images
    verdict.pictures[folder] = len(all_views)  # the loader has read each header
    for other in _other_folders(path, scene):
        problems, count = _check_folder(path / other, [view.name for view in all_views])
        verdict.pictures[other] = count
        verdict.problems += problems
    if decode:
        verdict.problems += _decode(name, all_views)
    return verdict


def _other_folders(path: Path, scene: Scene) -> list[str]:
    """images, images_2, ... besides the folder that was loaded."""
    if not (path / scene.protocol.images).is_dir():
        return []
    with os.scandir(path) as entries:
        names = [e.name for e in entries if e.is_dir() and (e.name == "images" or e.name.startswith("images_"))]
    return sorted(name for name in names if name != scene.protocol.images)


def _check_folder(folder: Path, names: Sequence[str]) -> tuple[list[str], int]:
    """(problems, readable pictures) of another folder with the same pictures."""
    try:
        files = find_pictures(folder, names)
    except SceneError as error:
        return [str(error)], 0
    problems = _each(files, picture_header)
    return _few(problems), len(files) - len(problems)


def _decode(name: str, views: Sequence[View]) -> list[str]:
    with track(f"decode {name}", total=len(views), unit="pictures") as bar:

        def decode(view: View) -> None:
            bar.advance()
            for load in (view.load, view.load_mask):
                if load is not None:
                    load()

        return _few(_each(views, decode))


def _changed(path: Path, recorded: Mapping[str, Any], *, checksums: bool) -> list[str]:
    """Differences from the record of the unpacked files, a line each."""
    problems = []
    with track(f"checksums of {path.name}", total=len(recorded), unit="files") as bar:
        for name, noted in recorded.items():
            bar.advance()
            if not isinstance(noted, list) or len(noted) != 2 or not is_inside(name):
                return ["the record of its files is damaged; fetch the scene again"]
            file = path / name
            try:
                size = file.stat().st_size
                if size != noted[0]:
                    problems.append(f"{name} has {size:,} bytes, {noted[0]:,} were unpacked")
                elif checksums and file_sha256(file) != noted[1]:
                    problems.append(f"{name} is not what was unpacked: its SHA-256 differs")
            except OSError as error:
                problems.append(f"{name}: {error.strerror or error}")
    return _few(problems)


def _each(items: Sequence[Any], check: Callable[[Any], Any]) -> list[str]:
    problems = []
    for item in items:
        try:
            check(item)
        except SceneError as error:
            problems.append(str(error))
    return problems


def _few(problems: list[str]) -> list[str]:
    more = len(problems) - MAX_PROBLEMS
    return problems if more <= 0 else [*problems[:MAX_PROBLEMS], f"and {more} more of this kind"]
