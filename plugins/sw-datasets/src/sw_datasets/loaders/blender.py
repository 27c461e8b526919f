"""NeRF-Synthetic scenes: transforms_train.json and transforms_test.json beside RGBA pictures."""

from __future__ import annotations

import json
import math
import os
from collections import ChainMap
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatwizard_core.api import SH_C0, Camera, PointCloud, Scene, SceneError, SceneOptions, View, stream
from sw_datasets.assemble import assemble_scene
from sw_datasets.families import BLENDER
from sw_datasets.pictures import (
    SUFFIXES,
    find_pictures,
    fitted_size,
    load_composited,
    load_mask,
    load_picture,
    picture_header,
)
from sw_datasets.rules import Rules, off_centre_warnings, rules_for, unused_option_warnings

HALF_CUBE = 1.3  # start points fill [-1.3, 1.3]^3 (3DGS)

DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Values of `camera_model`, which some programs write, that are a pinhole camera where all coefficients are 0."""


class BlenderDataset:
    """Blender scenes: camera-to-world matrices in OpenGL axes, split by file, white background by default."""

    def detect(self, path: Path) -> float:
        """0.5 with transforms_train.json, else 0."""
        return 0.5 if has_blender_layout(path) else 0.0

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Read poses and the sizes of the pictures; no pixel is decoded. Raises SceneError in one line."""
        return load_blender(path, rules_for(BLENDER, path.resolve().name, options), options)


def has_blender_layout(path: Path) -> bool:
    """Whether a folder is a Blender scene."""
    return os.path.isfile(path / "transforms_train.json")


def load_blender(path: Path, rules: Rules, options: SceneOptions) -> Scene:
    """The scene of a Blender folder, read by `rules`. Raises SceneError in one line."""
    warnings: list[str] = []
    train, off_centre = _read_views(path, "transforms_train.json", rules)
    test: list[View] = []
    if (path / "transforms_test.json").is_file():
        test, of_test = _read_views(path, "transforms_test.json", rules)
        off_centre = max(off_centre, of_test)
    elif rules.split == "file" and options.split is None:
        rules = replace(rules, split="every8")
        warnings.append(f"there is no transforms_test.json: the training views are split by {rules.split}")
    published = rules.family.views
    if rules.scene is not None and published is not None and (len(train), len(test)) != published:
        warnings.append(
            f"{rules.family.title} has {published[0]} training and {published[1]} test views a scene, this folder "
            f"{len(train)} and {len(test)}: figures are not comparable with published ones"
        )
    warnings += off_centre_warnings(off_centre, rules)
    warnings += unused_option_warnings(
        options, ("mask_background",), rules.family
    )  # alpha always cuts these pictures out
    return assemble_scene(
        path.resolve().name,
        train + test,
        points=random_points(options.init_points, options.seed),
        protocol=replace(rules, masked=False).protocol("rgba"),
        path=str(path),
        own_split=(train, test),
        warnings=warnings,
    )


def random_points(count: int, seed: int) -> PointCloud:
    """`count` points, uniform in the cube [-1.3, 1.3]^3, practically mid grey.

    The colour is 0.5 + C0 u with u uniform in [0, 1/255), as the 3DGS code draws spherical-harmonics values.
    """
    generator = stream(seed, "random-points")
    xyz = (2 * torch.rand(count, 3, generator=generator) - 1) * HALF_CUBE
    return PointCloud(xyz, 0.5 + SH_C0 * torch.rand(count, 3, generator=generator) / 255)


def _read_views(path: Path, file: str, rules: Rules) -> tuple[list[View], float]:
    """The views of one transforms file, and how far a principal point lies off the middle at the most, pixels."""
    where = f"{path / file}"
    data = _read_json(path / file)
    frames = data.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise SceneError(f"{where}: 'frames' must be a list of objects", path=str(path))
    names = []
    for i, frame in enumerate(frames):
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise SceneError(f"{where}: frame {i} has no 'file_path'", path=str(path))
        name = name.removeprefix("./")
        # As the data set has it, without a suffix; a picture that has one and is gone may have been converted.
        bare = os.path.splitext(name)[1].lower() not in SUFFIXES and not os.path.isfile(path / name)
        names.append(name + ".png" if bare else name)
    views, off_centre = [], 0.0
    for frame, name, picture in zip(frames, names, find_pictures(path, names), strict=True):
        merged = ChainMap(frame, data)
        model = merged.get("camera_model")
        if model not in (None, *PINHOLES) or merged.get("is_fisheye"):
            raise SceneError(
                f"{where}: image '{name}' is of a camera of another kind ("
                + ("is_fisheye" if model in (None, *PINHOLES) else f"camera_model {str(model)[:40]!r}")
                + "); 3DGS needs pinhole images: undistort them",
                path=str(path),
            )
        if any(_number(merged.get(key, 0), key, name, where) for key in DISTORTION_KEYS):
            raise SceneError(
                f"{where}: image '{name}' has lens distortion ({', '.join(DISTORTION_KEYS)}); "
                "undistort its pictures and strike the coefficients out (sw data undistort does it for COLMAP scenes)",
                path=str(path),
            )
        width, height, has_alpha = picture_header(picture)
        fx, fy, cx, cy = _intrinsics(merged, name, where, width, height)
        off_centre = max(off_centre, abs(cx - width / 2), abs(cy - height / 2))
        if rules.principal_point != "file":
            cx, cy = width / 2, height / 2
        R, tau = _pose(frame.get("transform_matrix"), name, where)
        size = fitted_size(width, height, rules.resolution)
        camera = Camera(width, height, fx, fy, cx, cy, R, tau).resized(*size)
        mask = partial(load_mask, picture, size) if has_alpha else None
        load = partial(load_picture, picture, size)
        if rules.composite8:
            load = partial(load_composited, picture, size, 0 if rules.background == "black" else 255)
        views.append(View(camera, name, load, mask))
    return views, off_centre


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise SceneError(f"{path} is missing: {path.parent} is no Blender scene", path=str(path)) from None
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not readable JSON ({error})", path=str(path)) from error
    if not isinstance(data, dict):
        raise SceneError(f"{path}: must hold an object with 'camera_angle_x' and 'frames'", path=str(path))
    return data


def _number(value: Any, key: str, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SceneError(f"{where}: '{key}' of image '{name}' is {value!r}, not a number")
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _intrinsics(values: Mapping[str, Any], name: str, where: str, width: int, height: int) -> tuple[float, ...]:
    """fx, fy, cx, cy in pixels of the file: from fl_x / fl_y (scaled from w, h if given), else camera_angle_x.

    Square pixels unless fl_y says otherwise, so the vertical field of view follows from the aspect ratio.
    """
    sx = width / max(_number(values.get("w", width), "w", name, where), 1e-9)
    sy = height / max(_number(values.get("h", height), "h", name, where), 1e-9)
    if "fl_x" in values:
        fx = _number(values["fl_x"], "fl_x", name, where) * sx
        fy = _number(values["fl_y"], "fl_y", name, where) * sy if "fl_y" in values else fx
    elif "camera_angle_x" in values:
        angle = _number(values["camera_angle_x"], "camera_angle_x", name, where)
        if not 0 < angle < math.pi:
            raise SceneError(f"{where}: camera_angle_x is {angle}, must lie between 0 and pi radians")
        fx = fy = width / (2 * math.tan(angle / 2))
    else:
        raise SceneError(f"{where}: neither 'camera_angle_x' nor 'fl_x' is given for image '{name}'")
    cx = _number(values["cx"], "cx", name, where) * sx if "cx" in values else width / 2
    cy = _number(values["cy"], "cy", name, where) * sy if "cy" in values else height / 2
    return fx, fy, cx, cy


def _pose(matrix: Any, name: str, where: str) -> tuple[torch.Tensor, torch.Tensor]:
    """(R [3,3], tau [3]) float32, world to camera, from a camera-to-world matrix in OpenGL axes."""
    try:
        c2w = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        c2w = np.empty(0)
    if c2w.shape not in ((4, 4), (3, 4)):
        raise SceneError(f"{where}: 'transform_matrix' of image '{name}' is not a 4x4 matrix")
    if not np.isfinite(c2w).all():
        raise SceneError(f"{where}: the pose of image '{name}' is not finite (NaN or infinite)")
    R = (c2w[:3, :3] * np.array([1.0, -1.0, -1.0])).T  # OpenGL looks along -z with y up; ours +z, y down
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise SceneError(f"{where}: 'transform_matrix' of image '{name}' is not a rotation and a translation")
    return torch.from_numpy(R).float(), torch.from_numpy(-R @ c2w[:3, 3]).float()
