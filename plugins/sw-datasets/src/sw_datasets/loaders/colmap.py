"""COLMAP reconstructions: images/ beside sparse/0/ with cameras, images and points3D as .bin or .txt."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import torch

from splatwizard_core.api import Camera, PointCloud, Scene, SceneError, SceneOptions, View
from sw_datasets.assemble import assemble_scene
from sw_datasets.families import COLMAP
from sw_datasets.loaders.colmap_model import ColmapCamera, ColmapImage, ColmapPoints, read_model
from sw_datasets.pictures import (
    find_pictures,
    fitted_size,
    list_pictures,
    load_cut_out,
    load_mask,
    load_picture,
    picture_header,
)
from sw_datasets.rules import Rules, off_centre_warnings, rules_for, unused_option_warnings

PLAIN_FOCALS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2}
RADIAL_FOCALS = {"SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2, "FOV": 2}
"""Models that are a pinhole camera when all their coefficients are 0 -> number of focal lengths.

The fisheye models are not: with zero coefficients they are still an equidistant projection.
"""

MAX_SIDE = 1 << 24
"""Pixels; wider is a damaged file (text may state any integer, also one that no float can hold)."""


MaskFinder = Callable[[Path, Sequence[str]], "list[Path | None]"]
"""(scene folder, image names) -> the mask file of each image, None where there is none."""


class ColmapDataset:
    """COLMAP scenes: a sparse model with its pictures; pinhole cameras."""

    def detect(self, path: Path) -> float:
        """0.5 with cameras and images files in sparse/0 or sparse, 0.45 with the cameras alone, else 0."""
        model = model_folder(path)
        if model is None:
            return 0.0
        return 0.5 if _has(model, "images") else 0.45

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Read poses, points and the sizes of the pictures; no pixel is decoded. Raises SceneError in one line."""
        return load_colmap(path, rules_for(COLMAP, path.resolve().name, options), options)


def load_colmap(path: Path, rules: Rules, options: SceneOptions, *, masks: MaskFinder | None = None) -> Scene:
    """The scene of a COLMAP folder, read by `rules`.

    masks   finds the mask files; None: `mask_files`

    Raises SceneError in one line.
    """
    folder = model_folder(path)
    if folder is None:
        raise SceneError(f"{path}: no sparse/0/cameras.bin (or .txt); run COLMAP first", path=str(path))
    model = read_model(folder)
    if not len(model.points):
        raise SceneError(
            f"{folder}: the reconstruction has no 3D points (points3D is empty); run COLMAP's mapper again",
            path=str(path),
        )
    picture_folder = rules.images or "images"
    images = sorted(model.images.values(), key=lambda image: image.name)
    if not images:
        raise SceneError(f"{folder}: no registered image; a scene needs at least 2", path=str(path))
    names = [image.name for image in images]
    files = find_pictures(_existing(path, picture_folder), names)
    warnings = _unused(path / picture_folder, len(images))
    off_centre = 0.0
    views = []
    for image, file, mask in zip(images, files, (masks or mask_files)(path, names), strict=True):
        if image.camera_id not in model.cameras:
            raise SceneError(
                f"{folder}: image '{image.name}' refers to camera {image.camera_id}, which is not in cameras",
                path=str(path),
            )
        intrinsics = model.cameras[image.camera_id]
        fx, fy, cx, cy = pinhole(intrinsics, path)
        off_centre = max(off_centre, abs(cx - intrinsics.width / 2), abs(cy - intrinsics.height / 2))
        if rules.principal_point != "file":
            cx, cy = intrinsics.width / 2, intrinsics.height / 2
        R, tau = pose(image)
        camera = Camera(intrinsics.width, intrinsics.height, fx, fy, cx, cy, R, tau)
        width, height, has_alpha = picture_header(file)
        size = fitted_size(width, height, rules.resolution)
        if mask is None and has_alpha:
            mask = file
        load = partial(load_picture, file, size, alpha=has_alpha and rules.masked)
        if rules.masked and not has_alpha:
            if mask is None:
                raise SceneError(
                    f"{path}: mask_background needs a mask for every image, and '{image.name}' has neither alpha nor "
                    "a file in masks/",
                    path=str(path),
                )
            load = partial(load_cut_out, file, mask, size)
        # The field of view is that of COLMAP's own size, whatever the size of the file: focal lengths scale along.
        views.append(
            View(camera.resized(*size), image.name, load, None if mask is None else partial(load_mask, mask, size))
        )
    warnings += off_centre_warnings(off_centre, rules)
    warnings += unused_option_warnings(options, ("legacy_8bit_composite", "init_points"), rules.family)
    return assemble_scene(
        path.resolve().name,
        views,
        points=point_cloud(model.points),
        protocol=rules.protocol(),
        path=str(path),
        warnings=warnings,
    )


def model_folder(path: Path) -> Path | None:
    """sparse/0 or sparse below `path`, whichever holds a cameras file; None if neither does."""
    for folder in (path / "sparse" / "0", path / "sparse"):
        if _has(folder, "cameras"):
            return folder
    return None


def pinhole(camera: ColmapCamera, scene: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of COLMAP's own image size.

    Raises SceneError for a lens model with distortion, naming it and the command that removes it.
    """
    focals = PLAIN_FOCALS.get(camera.model) or RADIAL_FOCALS.get(camera.model)
    if focals is None or any(camera.params[focals + 2 :]):
        raise SceneError(
            f"{scene}: camera {camera.id} has the distorted lens model {camera.model}; 3DGS needs pinhole images: "
            f"sw data undistort {scene} OUT writes an undistorted copy",
            path=str(scene),
        )
    if not (0 < camera.width < MAX_SIDE and 0 < camera.height < MAX_SIDE):
        raise SceneError(f"{scene}: camera {camera.id} is {camera.width}x{camera.height} px", path=str(scene))
    fx, fy = camera.params[0], camera.params[focals - 1]
    return fx, fy, camera.params[focals], camera.params[focals + 1]


def pose(image: ColmapImage) -> tuple[torch.Tensor, torch.Tensor]:
    """(R [3,3], tau [3]) float32 of a registered image; NaN where the quaternion is zero or not finite."""
    q = np.array(image.qvec)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        q = q / np.abs(q).max()  # so that the squares neither overflow nor vanish
        w, x, y, z = q / np.sqrt((q * q).sum())
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    return torch.from_numpy(R).float(), torch.tensor(image.tvec, dtype=torch.float64).float()


def point_cloud(points: ColmapPoints) -> PointCloud:
    """Points and colours of a model as float32."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, and is dropped as such
        xyz = points.xyz.astype(np.float32)
    return PointCloud(torch.from_numpy(xyz), torch.from_numpy(points.rgb.astype(np.float32) / 255))


def mask_files(path: Path, names: Sequence[str]) -> list[Path | None]:
    """The mask of each image: masks/NAME.png (COLMAP's way), masks/NAME, or masks/STEM.png; also in mask/."""
    folder = next((path / name for name in ("masks", "mask") if (path / name).is_dir()), None)
    if folder is None:
        return [None] * len(names)
    found: list[Path | None] = []
    for name in names:
        candidates = (folder / f"{name}.png", folder / name, (folder / name).with_suffix(".png"))
        found.append(next((file for file in candidates if os.path.isfile(file)), None))
    return found


def _has(folder: Path, part: str) -> bool:
    return any(os.path.isfile(folder / f"{part}{suffix}") for suffix in (".bin", ".txt"))


def _existing(path: Path, picture_folder: str) -> Path:
    folder = path / picture_folder
    if not folder.is_dir():
        there = sorted(p.name for p in path.iterdir() if p.is_dir() and p.name.startswith("images"))
        hint = f"there is {', '.join(there)} (--images {there[0]})" if there else "no folder is called images*"
        raise SceneError(f"{path}: the picture folder '{picture_folder}' is missing; {hint}", path=str(path))
    return folder


def _unused(folder: Path, registered: int) -> list[str]:
    there = len(list_pictures(folder))
    if there <= registered:
        return []
    return [f"{there - registered} of {there} pictures in {folder.name} have no pose and are not used"]
