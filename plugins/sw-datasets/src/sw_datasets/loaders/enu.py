"""BungeeNeRF's own layout: images/ beside poses_enu.json, cameras in a local east-north-up frame, no points.

Each of the N rows of "poses" has 17 numbers: a 3x5 matrix, row by row, of camera-to-world rotation, position and
[height, width, focal length], then two depth bounds (the layout of LLFF, arXiv 1905.00889). The third axis of a camera
points backwards. Whether the first two are [right, up] (NeRF) or [down, right] (LLFF) the file does not say; in a frame
whose z is up, the one that stays level is the right one.
"""

from __future__ import annotations

import json
import os
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import Camera, PointCloud, Scene, SceneError, SceneOptions, View, stream
from sw_datasets.assemble import assemble_scene
from sw_datasets.pictures import fitted_size, list_pictures, load_picture, picture_header
from sw_datasets.rules import Rules, unused_option_warnings

POSES = "poses_enu.json"
DEPTHS = (0.8, 1.2)  # start points lie about the distance at which the cameras' axes meet


def has_enu_layout(path: Path) -> bool:
    """Whether a folder is in BungeeNeRF's own layout."""
    return os.path.isfile(path / POSES)


def load_enu(path: Path, rules: Rules, options: SceneOptions) -> Scene:
    """The scene of such a folder: the i-th row of poses is the i-th picture by name. Raises SceneError in one line."""
    folder = path / (rules.images or "images")
    if not folder.is_dir():
        raise SceneError(f"{path}: the picture folder '{folder.name}' is missing", path=str(path))
    names = list_pictures(folder)
    rows = read_poses(path / POSES)
    if len(rows) != len(names):
        raise SceneError(
            f"{path}: {POSES} has {len(rows)} poses, {folder.name} has {len(names)} pictures; both must match",
            path=str(path),
        )
    R = rotations(rows[:, :, :3], path)
    views = []
    for name, row, R_i in zip(names, rows, R, strict=True):
        h, w, focal = row[:, 4]
        if not (h > 0 and w > 0 and focal > 0):
            raise SceneError(f"{path / POSES}: height, width, focal of image '{name}' are {h:g}, {w:g}, {focal:g}")
        tau = -R_i @ row[:, 3]
        width, height, _ = picture_header(folder / name)
        size = fitted_size(width, height, rules.resolution)
        fx, fy = focal * width / w, focal * height / h  # the field of view is that of the file's own size
        camera = Camera(
            width, height, fx, fy, width / 2, height / 2,
            torch.from_numpy(R_i).float(), torch.from_numpy(tau).float(),
        )  # fmt: skip
        load = partial(load_picture, folder / name, size, alpha=False)
        views.append(View(camera.resized(*size), name, load))
    warnings = [
        f"{POSES} brings no points: {options.init_points:,} random ones are laid where the cameras look, "
        "figures are not comparable with those of the COLMAP layout"
    ]
    warnings += unused_option_warnings(
        options, ("principal_point", "mask_background", "legacy_8bit_composite"), rules.family
    )
    return assemble_scene(
        path.resolve().name,
        views,
        points=points_in_sight([view.camera for view in views], options.init_points, options.seed, path),
        protocol=rules.protocol(),
        path=str(path),
        warnings=warnings,
    )


def read_poses(path: Path) -> NDArray[np.float64]:
    """[N,3,5] float64: camera-to-world rotation, position, and (height, width, focal length) as last column.

    Raises SceneError for what is no such file.
    """
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not readable JSON ({error})", path=str(path)) from error
    poses = content.get("poses") if isinstance(content, dict) else None
    try:
        rows = np.array(poses, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        rows = np.empty(0)
    if rows.ndim != 2 or rows.shape[1] != 17:
        raise SceneError(f"{path}: 'poses' is not a list of rows of 17 numbers", path=str(path))
    if not np.isfinite(rows[:, :15]).all():
        bad = int(np.flatnonzero(~np.isfinite(rows[:, :15]).all(axis=1))[0])
        raise SceneError(f"{path}: the pose in row {bad} is not finite (NaN or infinite)", path=str(path))
    return rows[:, :15].reshape(-1, 3, 5)


def rotations(axes: NDArray[np.float64], path: Path) -> NDArray[np.float64]:
    """World-to-camera rotations [N,3,3] in OpenCV axes, from the cameras' axes (columns, [N,3,3]) in ENU."""
    if len(axes) and np.abs(axes.transpose(0, 2, 1) @ axes - np.eye(3)).max() > 1e-3:
        raise SceneError(f"{path / POSES}: the first three columns of a pose are not a rotation", path=str(path))
    tilt = np.abs(axes[:, 2, :2]).sum(axis=0)  # how far each of the first two axes leaves the horizontal
    if tilt[0] <= tilt[1]:
        right, down = axes[:, :, 0], -axes[:, :, 1]  # [right, up, backwards]
    else:
        right, down = axes[:, :, 1], axes[:, :, 0]  # [down, right, backwards]
    R = np.stack([right, down, -axes[:, :, 2]], axis=1)
    if (np.linalg.det(R) < 0).any():
        raise SceneError(f"{path / POSES}: a pose is mirrored", path=str(path))
    return R


def points_in_sight(cameras: list[Camera], count: int, seed: int, path: Path) -> PointCloud:
    """`count` mid-grey points in the cameras' fields of view, about as far as the point nearest to all optical axes.

    Raises SceneError where the axes are parallel, so that no depth follows from them.
    """
    centres = torch.stack([camera.center.double() for camera in cameras])
    forward = torch.stack([camera.R[2].double() for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]  # [n,3,3]
    normal = across.mean(0)
    # The smallest eigenvalue is the mean squared sine of the axes' angle to their common direction.
    if torch.linalg.eigvalsh(normal)[0] < 1e-6:
        raise SceneError(
            f"{path}: all cameras look in one direction, so no start points can be laid; use the COLMAP layout",
            path=str(path),
        )
    focus = torch.linalg.solve(normal, (across @ centres[:, :, None]).mean(0))[:, 0]
    generator = stream(seed, "random-points")
    which = torch.randint(len(cameras), (count,), generator=generator)
    u, v, share = torch.rand(3, count, generator=generator, dtype=torch.float64)
    depth = (focus - centres).norm(dim=1)[which] * (DEPTHS[0] + (DEPTHS[1] - DEPTHS[0]) * share)
    tangents = torch.tensor([camera.tan_half_fov for camera in cameras], dtype=torch.float64)[which]  # [count,2]
    ray = torch.stack([(2 * u - 1) * tangents[:, 0], (2 * v - 1) * tangents[:, 1], torch.ones_like(u)], dim=1)
    turn = torch.stack([camera.R.double() for camera in cameras])[which]  # [count,3,3] world -> camera
    xyz = centres[which] + depth[:, None] * (ray[:, None, :] @ turn)[:, 0]
    return PointCloud(xyz.float(), torch.full((count, 3), 0.5))
