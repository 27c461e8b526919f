"""Loads the scene that a user names, with the installed family that reads it."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from splatwizard_core.errors import SceneError, no_file
from splatwizard_core.plugins.catalogue import catalogue, package_of
from splatwizard_core.plugins.guards import one_line
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.scene.dataset import Dataset, SceneOptions
from splatwizard_core.scene.locate import is_procedural, locate
from splatwizard_core.scene.scene import Scene, View
from splatwizard_native import ForeseenError

if TYPE_CHECKING:
    from splatwizard_core.scene.locate import Families

log = logging.getLogger(__name__)

PICTURES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"))
"""Suffixes by which a folder of pictures without poses is known."""


def load_scene(spec: str, options: SceneOptions, plugins: PluginManager) -> Scene:
    """Load the scene that `spec` names.

    NAME, NAME:VARIANT  a scene that the procedural family NAME makes, and one of its variants
    a path              a scene folder; the registered family that recognises it best reads it
    family:path         the same, read as that family whatever it looks like
    dataset/scene       a scene below $SPLATWIZARD_DATA: read as that family if one has the dataset's name, else by the
                        family that recognises it, and the dataset's name goes into the protocol

    Raises SceneError in one or two lines: nothing there, no or several families, the package of the family is not
    installed, or what the loader found wrong.
    """
    families = plugins.datasets
    name, separator, rest = spec.partition(":")
    package = package_of(families.kind, name.partition("/")[0])
    if package is not None and not os.path.exists(spec):
        raise SceneError(f"scene '{spec}' is read by {package}, which is not installed: pip install {package}")
    if is_procedural(families, name) and not (separator and os.path.exists(spec)):
        return _loaded(families, name, Path(rest if separator else name), options)
    if separator and name in families and not os.path.exists(spec):
        return _loaded(families, name, locate(rest, families)[0], options)
    path, collection = locate(spec, families)
    if collection is not None and collection in families and not is_procedural(families, collection):
        return _loaded(families, collection, path, options)
    family, scene = _read(path, options, families)
    if collection is not None and not families.entry(family).declared.get("scenes"):
        scene.protocol = replace(scene.protocol, dataset=collection)
    return scene


def family_of(spec: str, families: Families) -> str | None:
    """Return the name of the family that reads `spec`, without reading it; None where `load_scene` would raise."""
    named = spec.replace(":", "/").partition("/")[0]
    if named in families and not os.path.exists(spec):
        return named
    try:
        return _recognise(locate(spec, families)[0], families)
    except SceneError:
        return None


class _BrokenFamilyError(SceneError):
    """A stranger's family broke where it should load a scene."""


def _read(path: Path, options: SceneOptions, families: Families, without: tuple[str, ...] = ()) -> tuple[str, Scene]:
    """Read a folder as the family that recognises it best; if that one breaks, as the next one, with a warning."""
    family = _recognise(path, families, without)
    try:
        return family, _loaded(families, family, path, options)
    except _BrokenFamilyError as error:
        try:
            found = _read(path, options, families, (*without, family))
        except SceneError:
            raise error from None
        log.warning("%s; it is read as '%s'", error, found[0])
        return found


def _loaded(families: Families, name: str, path: Path, options: SceneOptions) -> Scene:
    """Load by one family. Raises SceneError that names a stranger's package, whatever it breaks."""
    entry, family = families.entry(name), _family(families, name)
    if not entry.foreign:
        return family.load(path, options)
    try:
        with entry.held():
            scene: object = family.load(path, options)
        if not isinstance(scene, Scene):
            raise TypeError(f"load() gives {type(scene).__name__} for Scene")
        for views in (scene.train, scene.test):
            if not (isinstance(views, list) and all(isinstance(view, View) for view in views)):
                raise TypeError("train and test are no lists of View")
    except ForeseenError:
        raise
    except (Exception, SystemExit) as error:
        raise _BrokenFamilyError(f"{entry.whose} cannot load {path}: {one_line(error)}", path=str(path)) from error
    return scene


def _family(families: Families, name: str) -> Dataset:
    target = families.load(name)
    return target() if isinstance(target, type) else target


def _recognise(path: Path, families: Families, without: tuple[str, ...] = ()) -> str:
    """Name of the family with the highest detection score. Raises SceneError if none or several claim the path."""
    scores: dict[str, float] = {}
    for entry in (each for each in families if each.name not in without):
        try:
            with entry.held():
                score = float(_family(families, entry.name).detect(path))
            if not 0 <= score <= 1:
                raise ValueError(f"detect() gave {score}; it must be in 0..1")
            scores[entry.name] = score
        except (Exception, SystemExit) as error:  # of one family; the others are asked all the same
            log.warning("data set '%s' of %s: %s", entry.name, entry.distribution, one_line(error))
    best = max(scores.values(), default=0.0)
    if best <= 0:
        raise SceneError(_unrecognised(path, families, sorted(scores)), path=str(path))
    winners = sorted(name for name, score in scores.items() if score == best)
    if len(winners) > 1:
        raise SceneError(
            f"{path} could be any of: {', '.join(winners)}; say which with --scene {winners[0]}:{path}", path=str(path)
        )
    return winners[0]


def _unrecognised(path: Path, families: Families, asked: list[str]) -> str:
    if path.is_file():
        return f"{path} is a file, not a scene folder: name the folder, {path.parent}"
    if not path.is_dir():
        return f"{path}: {no_file(path)}"
    declared = [entry.declared for entry in families]
    looked_for = ", ".join(fields["looks_for"] for fields in declared if "looks_for" in fields)
    told = f"Looked for {looked_for or 'nothing'}; families asked: {', '.join(asked) or 'none'}"
    kind = families.kind
    absent = sorted({package for name in catalogue().get(kind, ()) if (package := package_of(kind, name)) is not None})
    told += "".join(f"; more are read by {package}: pip install {package}" for package in absent)
    folders = [path, path / "images", path / "input"]
    if any(p.suffix.lower() in PICTURES for folder in folders if folder.is_dir() for p in folder.iterdir()):
        cures = [fields["without_poses"] for fields in declared if "without_poses" in fields]
        cure = "".join(f": {text.replace('{path}', str(path))}" for text in cures[:1])
        return f"{path} holds pictures but no camera poses{cure}. {told}"
    return f"{path} is not a scene of a known family. {told}"
