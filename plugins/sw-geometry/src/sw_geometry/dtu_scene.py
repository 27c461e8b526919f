"""A prepared DTU scan: which mask and which projection belong to each view, and how its units become millimetres."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from splatwizard_core.api import Scene, SceneError, UserInputError, track
from splatwizard_core.tooling import DATA_VARIABLE
from sw_geometry.culling import RADIUS, Rule, kept_vertices, widened
from sw_geometry.mesh import Floats, Mask, Mesh

LARGEST_IN_SCENE = 100.0
"""Edge of a mesh's box, units of the scene, from which on it is taken for millimetres: the object fills a unit ball."""


def official_folder(named: str | None) -> Path:
    """The folder of the official files: the one that is named, else dtu_gt below $SPLATWIZARD_DATA."""
    if named:
        return Path(named)
    return Path(os.environ.get(DATA_VARIABLE) or ".") / "dtu_gt"


def in_millimetres(mesh: Mesh, scene: Scene) -> Mesh:
    """A mesh or points of the scene's units, in millimetres. Raises UserInputError if it is in those already."""
    scale, offset = _alignment(scene)
    span = np.ptp(mesh.vertices, axis=0).max(initial=0.0)
    if span > LARGEST_IN_SCENE:
        raise UserInputError(f"the mesh is {span:.0f} units wide: if it is in millimetres already, say --units mm")
    return mesh.moved(scale, offset)


def _alignment(scene: Scene) -> tuple[float, Floats]:
    if "scale_mats" not in scene.ground_truth:
        raise SceneError(f"scene {scene.name} has no cameras.npz: its units cannot become millimetres", path=scene.path)
    matrix = scene.ground_truth["scale_mats"][0].numpy()
    return float(matrix[0, 0]), matrix[:3, 3]


def culled(mesh: Mesh, scene: Scene, rule: Rule) -> Mesh:
    """The mesh, in units of the scene, without what the object masks of the views rule out: see `kept_vertices`."""
    if rule == "none":
        return mesh
    return mesh.with_vertices(kept_vertices(mesh.vertices, _views(scene), rule))


def _views(scene: Scene) -> Iterator[tuple[Floats, Mask]]:
    """(projection to the mask's pixels, widened mask) of each view; masks at their own size, never resized."""
    from PIL import Image

    folder = Path(scene.path or "") / "mask"
    there = os.listdir(folder) if folder.is_dir() else []
    names = sorted(each for each in there if each.lower().endswith(".png") and (folder / each).is_file())
    projections = (scene.ground_truth["world_mats"] @ scene.ground_truth["scale_mats"]).numpy()
    if len(names) != len(projections):
        raise SceneError(
            f"{folder}: {len(names)} masks for {len(projections)} cameras; without them say --cull none",
            path=str(folder),
        )
    names.sort(key=lambda name: [int(n) for n in re.findall(r"\d+", name)])
    with track("cull by masks", total=len(names), unit="views") as bar:
        for name, projection in zip(names, projections, strict=True):
            with Image.open(folder / name, formats=("PNG",)) as picture:
                pixels = np.asarray(picture)
            mask = np.asarray(pixels > 0 if pixels.ndim == 2 else (pixels > 0).any(axis=2))
            yield projection, widened(mask, RADIUS)
            bar.advance()
