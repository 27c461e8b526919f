"""From what the user typed to a Scene: the family is found, then asked to load."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import cast

from splatwizard_core.errors import PluginError, SceneError
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.scene.dataset import Dataset, SceneOptions
from splatwizard_core.scene.images import SUFFIXES
from splatwizard_core.scene.scene import Scene

log = logging.getLogger(__name__)

DATA_VARIABLE = "SPLATWIZARD_DATA"

DATASET_SPLITS = {"bungee": "lod:30", "dtu": "all"}
"""Collections whose published protocol is not the split of their family."""


def load_scene(spec: str, options: SceneOptions, plugins: PluginManager) -> Scene:
    """The scene that `spec` names.

    demo                the procedural scene; `demo:tiny` is a small one for tests
    a path              a scene folder; the registered family that recognises it best reads it
    family:path         the same, read as that family whatever it looks like (`colmap:scenes/garden`)
    dataset/scene       a scene below $SPLATWIZARD_DATA; the dataset's name goes into the protocol

    Raises SceneError in one or two lines: nothing there, no or several families, or what the loader found wrong.
    """
    if spec == "demo":
        return _dataset(plugins, "demo").load(Path("demo"), options)
    family, separator, rest = spec.partition(":")
    if separator and family in plugins.datasets and not os.path.exists(spec):
        if family == "demo":
            return _dataset(plugins, "demo").load(Path(rest), options)
        path, options, collection = _locate(rest, options)
        return _named(_dataset(plugins, family).load(path, options), collection)
    path, options, collection = _locate(spec, options)
    return _named(_dataset(plugins, _recognise(path, plugins)).load(path, options), collection)


def _dataset(plugins: PluginManager, family: str) -> Dataset:
    target = plugins.datasets.load(family)
    return cast(Dataset, target() if isinstance(target, type) else target)


def _locate(spec: str, options: SceneOptions) -> tuple[Path, SceneOptions, str | None]:
    """(folder, options with the collection's defaults, name of the collection or None)."""
    path = Path(os.path.expanduser(spec))
    if os.path.exists(path):
        return path, options, None
    root = os.environ.get(DATA_VARIABLE)
    if root and not path.is_absolute() and os.path.exists(found := Path(root) / spec):
        collection = path.parts[0] if len(path.parts) == 2 else None
        if collection in DATASET_SPLITS and options.split is None:
            options = replace(options, split=DATASET_SPLITS[collection])
        return found, options, collection
    tried = f", nor is {Path(root) / spec}" if root and not path.is_absolute() else ""
    hint = "" if root else f" (${DATA_VARIABLE} is not set, so dataset/scene names are not looked up)"
    raise SceneError(
        f"scene '{spec}' is not there{tried}: give a scene folder, dataset/scene, or demo{hint}", path=spec
    )


def _named(scene: Scene, collection: str | None) -> Scene:
    if collection is not None:
        scene.protocol = replace(scene.protocol, dataset=collection)
    return scene


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
        f"sparse/0/cameras.bin or .txt (COLMAP), transforms_train.json (Blender); families asked: {', '.join(families)}"
    )
    folders = [path, path / "images", path / "input"]
    if any(p.suffix.lower() in SUFFIXES for folder in folders if folder.is_dir() for p in folder.iterdir()):
        return (
            f"{path} holds pictures but no camera poses: run COLMAP on them first "
            f"(colmap automatic_reconstructor --image_path ... --workspace_path {path}). Looked for {looked_for}"
        )
    return f"{path} is not a scene of a known family. Looked for {looked_for}"
