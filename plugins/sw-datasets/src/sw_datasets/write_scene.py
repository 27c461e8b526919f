"""Writes a scene as a folder in a layout that the loaders and other programs read."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from splatwizard_core.api import Camera, ConfigError, PointCloud, Scene, SceneError, View, track
from splatwizard_core.tooling import write_atomic
from sw_datasets.loaders.colmap_model import (
    ColmapCamera,
    ColmapImage,
    ColmapModel,
    ColmapPoints,
    write_model,
)
from sw_datasets.picture_names import is_inside

FORMATS = ("colmap", "blender")


def write_scene(scene: Scene, path: Path, format: str = "colmap", *, text: bool = False) -> None:
    """Write pictures (PNG), cameras and points into the new or empty folder `path`.

    format  colmap: images/, sparse/0/ (the points without tracks); reading it back takes the scene's own split rule
            blender: train/, test/ and transforms_*.json, the split as it is; the points are not kept, since that
            layout has none
    text    COLMAP files as .txt

    Raises SceneError if the folder holds something, for names that lead out of it, and for cameras that the Blender
    layout cannot hold; ConfigError for an unknown format.
    """
    if format not in FORMATS:
        raise ConfigError(f"unknown scene format '{format}': one of {', '.join(FORMATS)}", key="format")
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise SceneError(f"{path} is there already and not empty; choose another folder", path=str(path))
    views = {view.name: view for view in scene.train + scene.test}
    for name in views:
        if not is_inside(name):
            raise SceneError(f"view name {name!r} leads out of the folder {path}", path=str(path))
    path.mkdir(parents=True, exist_ok=True)
    if format == "colmap":
        _write_colmap(scene, [views[name] for name in sorted(views)], path, text)
    else:
        _write_blender(scene, path)


def quaternion(R: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """(w, x, y, z), w >= 0, of a rotation matrix [3,3]: the leading eigenvector of Bar-Itzhack's symmetric matrix.

    Unlike formulas that divide by one component, it has no bad case near half turns.
    """
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array(
        [
            [a - e - i, d + b, g + c, h - f],
            [d + b, e - a - i, h + f, c - g],
            [g + c, h + f, i - a - e, d - b],
            [h - f, c - g, d - b, a + e + i],
        ]
    )
    x, y, z, w = np.linalg.eigh(K / 3)[1][:, -1]
    q = np.array([w, x, y, z]) * (-1 if w < 0 else 1)
    return float(q[0]), float(q[1]), float(q[2]), float(q[3])


def _save_picture(view: View, file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(view.pixels.permute(1, 2, 0).numpy()).save(file, format="PNG")


def _png_name(name: str) -> str:
    return name if name.lower().endswith(".png") else f"{name}.png"


def _write_colmap(scene: Scene, views: list[View], path: Path, text: bool) -> None:
    cameras: dict[int, ColmapCamera] = {}
    ids: dict[tuple[float, ...], int] = {}
    images: dict[int, ColmapImage] = {}
    with track("write pictures", total=len(views)) as bar:
        for i, view in enumerate(views, 1):
            c = view.camera
            key = (c.width, c.height, c.fx, c.fy, c.cx, c.cy)
            if key not in ids:
                ids[key] = len(ids) + 1
                cameras[ids[key]] = ColmapCamera(ids[key], "PINHOLE", c.width, c.height, (c.fx, c.fy, c.cx, c.cy))
            tx, ty, tz = c.tau.double().cpu().tolist()
            name = _png_name(view.name)
            images[i] = ColmapImage(
                i, quaternion(c.R.double().cpu().numpy()), (tx, ty, tz), ids[key], name,
                np.empty((0, 2)), np.empty(0, np.int64),
            )  # fmt: skip
            _save_picture(view, path / "images" / name)
            bar.advance(1)
    write_model(ColmapModel(cameras, images, _colmap_points(scene.points)), path / "sparse" / "0", text=text)


def _colmap_points(points: PointCloud | None) -> ColmapPoints:
    n = 0 if points is None else len(points)
    xyz = np.zeros((0, 3)) if points is None else points.xyz.double().cpu().numpy()
    rgb = np.full((n, 3), 128, np.uint8)
    if points is not None and points.rgb is not None:
        rgb = (points.rgb.cpu().clamp(0, 1) * 255).round().to(torch.uint8).numpy()
    return ColmapPoints(
        np.arange(1, n + 1), xyz, rgb, np.zeros(n), np.zeros(n + 1, np.int64), np.zeros((0, 2), np.int32)
    )


def _write_blender(scene: Scene, path: Path) -> None:
    header = _one_camera([view.camera for view in scene.train + scene.test], path)
    files = {}
    with track("write pictures", total=len(scene.train) + len(scene.test)) as bar:
        for part, views in (("train", scene.train), ("test", scene.test)):
            frames = []
            for view in views:
                name = _png_name(view.name)
                stem = f"{part}/{name}"[: -len(".png")]
                frames.append({"file_path": f"./{stem}", "transform_matrix": _opengl_pose(view.camera)})
                _save_picture(view, path / part / name)
                bar.advance(1)
            files[path / f"transforms_{part}.json"] = json.dumps({**header, "frames": frames}, indent=1)
    # Last, and the test half first: a folder that is not finished is not taken for a scene.
    for file in reversed(files):
        write_atomic(file, files[file])


def _one_camera(cameras: list[Camera], path: Path) -> dict[str, Any]:
    first = cameras[0]
    same = {(c.width, c.height, c.fx, c.fy, c.cx, c.cy) for c in cameras}
    if len(same) > 1 or first.fx != first.fy or (first.cx, first.cy) != (first.width / 2, first.height / 2):
        raise SceneError(
            f"{path}: the Blender layout holds one centred camera with square pixels; write format colmap instead"
        )
    return {"camera_angle_x": 2 * math.atan(first.width / (2 * first.fx))}


def _opengl_pose(camera: Camera) -> list[list[float]]:
    R, tau = camera.R.double().cpu().numpy(), camera.tau.double().cpu().numpy()
    c2w = np.eye(4)
    c2w[:3, :3] = R.T * np.array([1.0, -1.0, -1.0])
    c2w[:3, 3] = -R.T @ tau
    rows: list[list[float]] = c2w.tolist()
    return rows
