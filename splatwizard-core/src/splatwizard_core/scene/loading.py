"""From what the user typed to a Scene: the family is found, then asked to load."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import cast

from sw_datasets.families import BENCHMARKS

from splatwizard_core.errors import PluginError, SceneError
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.scene.dataset import Dataset, SceneOptions
from splatwizard_core.scene.images import SUFFIXES
from splatwizard_core.scene.locate import locate
from splatwizard_core.scene.scene import Scene

log = logging.getLogger(__name__)


def load_scene(spec: str, options: SceneOptions, plugins: PluginManager) -> Scene:
    """The scene that `spec` names.

    demo                the procedural scene; `demo:tiny` is a small one for tests
    a path              a scene folder; the registered family that recognises it best reads it
    family:path         the same, read as that family whatever it looks like (`colmap:scenes/garden`)
    dataset/scene       a scene below $SPLATWIZARD_DATA: read as that family if one has the dataset's name, else by the
                        family that recognises it, and the dataset's name goes into the protocol

    Raises SceneError in one or two lines: nothing there, no or several families, or what the loader found wrong.
    """
    if spec == "demo":
        return _dataset(plugins, "demo").load(Path("demo"), options)
    family, separator, rest = spec.partition(":")
    if separator and family in plugins.datasets and not os.path.exists(spec):
        if family == "demo":
            return _dataset(plugins, "demo").load(Path(rest), options)
        return _dataset(plugins, family).load(locate(rest)[0], options)
    path, collection = locate(spec)
    if collection is not None and collection in plugins.datasets and collection != "demo":
        return _dataset(plugins, collection).load(path, options)
    family = _recognise(path, plugins)
    scene = _dataset(plugins, family).load(path, options)
    if collection is not None and family not in BENCHMARKS:
        scene.protocol = replace(scene.protocol, dataset=collection)
    return scene


def _dataset(plugins: PluginManager, family: str) -> Dataset:
    target = plugins.datasets.load(family)
    return cast(Dataset, target() if isinstance(target, type) else target)


def _recognise(path: Path, plugins: PluginManager) -> str:
    """The family with the highest detection score. Raises SceneError if none or several claim the path."""
    scores: dict[str, float] = {}
    for entry in plugins.datasets:
        try:
            scores[entry.name] = float(_dataset(plugins, entry.name).detect(path))
        except PluginError as error:
            log.warning("%s", error)
    best = max(scores.values(), default=0.0)
    if best <= 0:
        raise SceneError(_unrecognised(path, sorted(scores)), path=str(path))
    winners = sorted(name for name, score in scores.items() if score == best)
    if len(winners) > 1:
        raise SceneError(
            f"{path} could be any of: {', '.join(winners)}; say which with --scene {winners[0]}:{path}", path=str(path)
        )
    return winners[0]


def _unrecognised(path: Path, families: list[str]) -> str:
    if path.is_file():
        return f"{path} is a file, not a scene folder"
    looked_for = (
        "sparse/0/cameras.bin or .txt (COLMAP), transforms_train.json (Blender), poses_enu.json (BungeeNeRF); "
        f"families asked: {', '.join(families)}"
    )
    folders = [path, path / "images", path / "input"]
    if any(p.suffix.lower() in SUFFIXES for folder in folders if folder.is_dir() for p in folder.iterdir()):
        return (
            f"{path} holds pictures but no camera poses: run COLMAP on them first "
            f"(colmap automatic_reconstructor --image_path ... --workspace_path {path}). Looked for {looked_for}"
        )
    return f"{path} is not a scene of a known family. Looked for {looked_for}"
