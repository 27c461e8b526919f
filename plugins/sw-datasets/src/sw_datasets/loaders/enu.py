"""BungeeNeRF's own layout: images/ beside poses_enu.json, cameras in a local east-north-up frame, no points.

Each of the N rows of "poses" has 17 numbers: a 3x5 matrix, row by row, of camera-to-world rotation, position and
[height, width, focal length], then two depth bounds (the layout of LLFF, arXiv 1905.00889). The third axis of a camera
points backwards. Whether the first two are [right, up] (NeRF) or [down, right] (LLFF) the file does not say; in a frame
whose z is up, the one that stays level is the right one.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import Camera, Scene, SceneError, SceneOptions
from splatwizard_core.tooling import json_reason
from sw_datasets.assemble import assemble_scene
from sw_datasets.image_checks import Gate
from sw_datasets.loaders.transforms import unused_keys
from sw_datasets.picture_names import list_pictures
from sw_datasets.rules import Rules, unused_option_warnings
from sw_datasets.start_points import points_in_sight_of

POSES = "poses_enu.json"


def has_enu_layout(path: Path) -> bool:
    """Whether a folder is in BungeeNeRF's own layout."""
    return os.path.isfile(path / POSES)


def load_enu(path: Path, rules: Rules, options: SceneOptions) -> Scene:
    """The scene of such a folder: the i-th row of poses is the i-th picture by name. Raises SceneError in one line."""
    folder = path / (rules.images or "images")
    if not folder.is_dir():
        raise SceneError(f"{path}: the picture folder '{folder.name}' is missing", path=str(path))
    names = list_pictures(folder)
    rows, others = read_poses(path / POSES)
    if len(rows) != len(names):
        raise SceneError(
            f"{path}: {POSES} has {len(rows)} poses, {folder.name} has {len(names)} pictures; both must match",
            path=str(path),
        )
    R = rotations(rows[:, :, :3], path)
    views = []
    gate = Gate(path, rules)
    for name, row, R_i in zip(names, rows, R, strict=True):
        h, w, focal = row[:, 4]
        if not (h > 0 and w > 0 and focal > 0):
            raise SceneError(f"{path / POSES}: height, width, focal of image '{name}' are {h:g}, {w:g}, {focal:g}")
        tau = -R_i @ row[:, 3]
        picture = gate.admit(name, folder / name, (round(w), round(h)))
        camera = Camera(
            round(w), round(h), focal, focal, w / 2, h / 2, torch.from_numpy(R_i), torch.from_numpy(tau)
        )  # fmt: skip
        views.append(gate.view(name, picture, camera))
    warnings = [
        f"{POSES} brings no points: {options.init_points:,} random ones are laid where the cameras look, "
        "figures are not comparable with those of the COLMAP layout"
    ]
    warnings += [*unused_keys(POSES, others), *gate.warnings()]
    warnings += unused_option_warnings(options, ("principal_point", "legacy_8bit_composite"), rules.family)
    return assemble_scene(
        path.resolve().name,
        views,
        points=points_in_sight_of(options)(views),
        train_points=points_in_sight_of(options),
        protocol=rules.protocol(masked=gate.masked, turned=gate.turned),
        path=str(path),
        warnings=warnings,
        finds_lists=rules.finds_lists,
    )


def read_poses(path: Path) -> tuple[NDArray[np.float64], set[str]]:
    """[N,3,5] float64: camera-to-world rotation, position, (height, width, focal length) as last column; other keys.

    Raises SceneError for what is no such file.
    """
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not readable JSON ({json_reason(error)})", path=str(path)) from error
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
    return rows[:, :15].reshape(-1, 3, 5), {str(key) for key in content} - {"poses"}


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
