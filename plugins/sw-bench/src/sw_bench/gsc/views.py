"""The cameras that a model is seen from: of a scene, a file of cameras, the model's own comments, or generated ones."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch

from splatwizard_core.api import Camera, GaussianModel, SceneOptions, UserInputError, View
from splatwizard_core.tooling import PluginManager, load_scene

GENERATED_SIZE = (1280, 720)
LARGEST_SIDE = 8192  # pixels
LEAST_OPACITY, LARGEST_SHARE, FEWEST = 0.1, 0.999, 100
"""Gaussians that decide about generated cameras: opaque, not the largest 0.1 %; all if fewer than 100 stay."""
INSIDE = 0.1  # share of the weight in the inner half of the radius, below which the cameras are put inside


@dataclass(frozen=True)
class Asked:
    """Wishes of the user about the views.

    cameras     a scene's folder or a file of cameras; None: the model's comments, or generated ones
    views       "all", "every<n>", or names or numbers with commas; None: a scene's test views, else all
    size        width and height of pictures of cameras that have none
    up          world direction of generated cameras; None: -y, "auto" of the model's thinnest axis
    path        "auto", "orbit16" or "inside16"
    quaternion  whether comments' quaternions turn world to camera ("w2c") or back ("c2w")
    """

    cameras: Path | None = None
    views: str | None = None
    size: tuple[int, int] | None = None
    up: str | None = None
    path: str = "auto"
    quaternion: str = "w2c"


@dataclass(frozen=True)
class Views:
    """Cameras of one model in order, with names; photographs where they come from a scene.

    kind    word of the protocol id: "colmap", "json", "ply", "orbit16", "inside16"
    notes   lines about how they were chosen, for the record
    """

    kind: str
    cameras: list[Camera]
    names: list[str]
    photographs: list[View] | None = None
    notes: list[str] = field(default_factory=list)

    @property
    def label(self) -> str:
        """Kind and hash of the cameras."""
        return f"{self.kind}:{camera_hash(self.cameras)}"

    @property
    def size(self) -> str:
        """WIDTHxHEIGHT, or "mixed"."""
        sizes = {(camera.width, camera.height) for camera in self.cameras}
        return "mixed" if len(sizes) > 1 else "x".join(map(str, sizes.pop()))

    def part(self, kept: Sequence[int]) -> Views:
        """Only these of them."""
        photographs = None if self.photographs is None else [self.photographs[i] for i in kept]
        return replace(
            self, cameras=[self.cameras[i] for i in kept], names=[self.names[i] for i in kept], photographs=photographs
        )


def views_of(file: Path, model: GaussianModel, asked: Asked, plugins: PluginManager) -> Views:
    """Find the cameras for a model's file, the first that applies. Raises UserInputError, SceneError."""
    if asked.cameras is not None:
        found = _of_scene(asked.cameras, asked, plugins) if _is_scene(asked.cameras) else _of_file(asked.cameras)
    else:
        found = _of_comments(file, asked) or _generated(model, asked)
    if found.photographs is None or asked.views is not None:
        found = _chosen(found, asked.views or "all")
    return found


def camera_hash(cameras: Sequence[Camera]) -> str:
    """First 8 digits of SHA-256 over rows of R, t, fx, fy, cx, cy, width and height with six decimals, in order."""
    lines = []
    for c in cameras:
        numbers = [
            *c.R.double().flatten().tolist(),
            *c.tau.double().tolist(),
            c.fx,
            c.fy,
            c.cx,
            c.cy,
            c.width,
            c.height,
        ]
        lines.append(" ".join(f"{round(number, 6) + 0.0:.6f}" for number in numbers))  # + 0.0: no -0
    return hashlib.sha256("".join(f"{line}\n" for line in lines).encode()).hexdigest()[:8]


def _is_scene(path: Path) -> bool:
    return path.is_dir() or path.name.startswith("transforms")


def _of_scene(path: Path, asked: Asked, plugins: PluginManager) -> Views:
    folder = path if path.is_dir() else path.parent
    split = "all" if asked.views is not None else None
    scene = load_scene(str(folder), SceneOptions(split=split), plugins)
    kind = "colmap" if scene.protocol.dataset not in ("blender", "transforms", "nerf_synthetic") else "json"
    views = scene.test
    told = "all views" if split else f"test views by {scene.protocol.split}"
    notes = [f"cameras of the scene {scene.name}, {told}", *scene.warnings]
    if any(scene.origin):
        raise UserInputError(
            f"{folder}: the scene lies far from its origin; its cameras do not fit the file of a model"
        )
    return Views(kind, [v.camera for v in views], [v.name for v in views], views, notes)


def _of_file(path: Path) -> Views:
    from sw_gaussians.camera_files import read_cameras

    cameras = read_cameras(path).cameras
    return Views("json", cameras, [f"{i:03d}" for i in range(len(cameras))], notes=[f"cameras of {path.name}"])


def _of_comments(file: Path, asked: Asked) -> Views | None:
    from sw_interchange.ply_cameras import read_ply_cameras

    rows = read_ply_cameras(file)
    if not rows:
        return None
    if asked.size is None:
        raise UserInputError(f"{file.name} holds cameras, but not the size of their pictures: give --size WIDTHxHEIGHT")
    width, height = asked.size
    cameras = []
    for row in rows:
        w, x, y, z = row.quat
        R = torch.tensor(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ],
            dtype=torch.float64,
        )
        R = R if asked.quaternion == "w2c" else R.T.contiguous()
        tau = -R @ torch.tensor(row.center, dtype=torch.float64)
        cameras.append(Camera(width, height, row.fx, row.fy, width / 2, height / 2, R.float(), tau.float()))
    notes = [f"cameras of the comments of {file.name}, quaternions {asked.quaternion}"]
    return Views("ply", cameras, [row.name for row in rows], notes=notes)


def _generated(model: GaussianModel, asked: Asked) -> Views:
    try:
        from sw_gaussians.ring_cameras import ring_cameras, ring_extent
    except ImportError:  # before 0.4
        raise UserInputError("this sw-gaussians makes no cameras: give --cameras SCENE or a file of cameras") from None

    points, weights = weighted_points(model)
    kind, notes = asked.path, []
    if kind == "auto":
        center, half = ring_extent(model)
        radius = float(np.linalg.norm(half)) or 1.0
        away = np.linalg.norm(points - center, axis=1)
        near = float(weights[away <= radius / 2].sum())
        around = float(weights[(away > radius / 2) & (away <= radius)].sum())
        kind = "inside16" if near < INSIDE * (near + around) else "orbit16"
        notes.append(f"path {kind}: weight {near:.6g} within half of the radius, {around:.6g} up to it")
    up = _up(asked.up, points, weights)
    notes.append(f"up {up[0]:g}, {up[1]:g}, {up[2]:g}")
    cameras = ring_cameras(model, kind, size=asked.size or GENERATED_SIZE, up=up)
    return Views(kind, cameras, [f"{i:03d}" for i in range(len(cameras))], notes=notes)


def weighted_points(model: GaussianModel) -> tuple[np.ndarray, np.ndarray]:
    """Means [N,3] and opacities [N] of the Gaussians that decide about generated cameras, float64."""
    with torch.no_grad():
        points = model.means.double().cpu().numpy()
        weights = model.opacities.double().cpu().numpy()
        largest = model.scales.double().max(dim=1).values.cpu().numpy()
    kept = (weights >= LEAST_OPACITY) & (largest <= np.quantile(largest, LARGEST_SHARE))
    return (points[kept], weights[kept]) if kept.sum() >= FEWEST else (points, weights)


def _up(text: str | None, points: np.ndarray, weights: np.ndarray) -> tuple[float, float, float]:
    """The direction asked for. Raises UserInputError for what is none."""
    if text is None:
        return (0.0, -1.0, 0.0)
    if text == "auto":
        total = weights.sum() or 1.0
        mean = (weights[:, None] * points).sum(axis=0) / total
        variance = (weights[:, None] * (points - mean) ** 2).sum(axis=0) / total
        axis = int(variance.argmin())
        found = [0.0, 0.0, 0.0]
        found[axis] = -1.0 if axis == 1 else 1.0  # towards -y where it has a part of it
        return (found[0], found[1], found[2])
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        raise UserInputError(f"--up {text}: give x,y,z or auto") from None
    if not 1e-9 < abs(x) + abs(y) + abs(z) < 1e9:
        raise UserInputError(f"--up {text}: give a direction")
    return (x, y, z)


def _chosen(found: Views, asked: str) -> Views:
    """The views that are named. Raises UserInputError for one that is not there."""
    if asked == "all":
        return found
    if (every := re.fullmatch(r"every(\d{1,6})", asked)) is not None and int(every[1]) > 0:
        return found.part(range(0, len(found.names), int(every[1])))
    kept = []
    for word in filter(None, (part.strip() for part in asked.split(","))):
        if word in found.names:
            kept.append(found.names.index(word))
        elif word.isdigit() and int(word) < len(found.names):
            kept.append(int(word))
        else:
            raise UserInputError(f"--views: there is no view '{word}' among {len(found.names)}: give numbers or names")
    if not kept:
        raise UserInputError("--views is empty: give all, every<n>, or names with commas")
    return found.part(list(dict.fromkeys(kept)))


def size_of(text: str | None) -> tuple[int, int] | None:
    """Width and height of WIDTHxHEIGHT. Raises UserInputError."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,5})[xX](\d{1,5})", text)
    if match is None or not all(1 <= int(side) <= LARGEST_SIDE for side in match.groups()):
        raise UserInputError(f"--size {text}: give WIDTHxHEIGHT, 1 to {LARGEST_SIDE} pixels each, as 1280x720")
    return int(match[1]), int(match[2])
