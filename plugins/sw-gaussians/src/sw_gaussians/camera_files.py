"""Camera files: `cameras.json` of the 3DGS code, and camera paths of the nerfstudio viewer."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from splatwizard_core.api import Camera, SceneError

LARGEST_FILE = 64 << 20  # bytes; a camera takes 400
MOST_CAMERAS = 100_000
LARGEST_SIDE = 16_384  # pixels
ROTATION_TOLERANCE = 1e-2
"""Tolerance per entry of R R^T - I: files store few digits. R is orthonormalised afterwards."""


@dataclass(frozen=True)
class CameraFile:
    """Cameras in file order, and the frames per second that the file asks for, or None."""

    cameras: list[Camera]
    fps: float | None = None


def read_cameras(path: str | Path) -> CameraFile:
    """Read a list of cameras, at least one.

    cameras.json of 3DGS is a list of {"width", "height", "fx", "fy", "position" [3], "rotation" [3][3]}, in pixels.
    "position" is the camera centre, "rotation" maps camera to world in OpenCV axes (x right, y down, z forward).
    "cx" and "cy" in pixels are optional (default: the image centre).

    A nerfstudio path is an object with "render_width", "render_height", "fps" and "camera_path". The latter is a list
    of {"camera_to_world" [16] by rows in OpenGL axes (x right, y up, z backward), "fov" vertical, degrees}, in the
    frame that nerfstudio gave the scene.

    Raises SceneError with the place of what is wrong.
    """
    path = Path(path)
    try:
        if path.stat().st_size > LARGEST_FILE:
            raise SceneError(
                f"{path}: larger than {LARGEST_FILE >> 20} MiB, which is no file of cameras", path=str(path)
            )
        found = json.loads(path.read_bytes())
    except OSError as error:
        raise SceneError(f"{path}: cannot be read: {error.strerror}", path=str(path)) from error
    except (ValueError, RecursionError):
        raise SceneError(f"{path}: not a JSON file of cameras", path=str(path)) from None
    fps = None
    if isinstance(found, dict) and isinstance(found.get("camera_path"), list):
        entries, read = found["camera_path"], _path_camera
        fps = _number(found, "fps", path.name, low=1e-3, high=1e3) if "fps" in found else None
        if found.get("camera_type", "perspective") != "perspective":
            raise SceneError(f"{path}: cameras of type '{found['camera_type']!s:.40}'; perspective is possible")
    elif isinstance(found, list):
        entries, read = found, _listed_camera
    else:
        raise SceneError(f"{path}: neither a list of cameras nor an object with 'camera_path'", path=str(path))
    if not 0 < len(entries) <= MOST_CAMERAS:
        raise SceneError(f"{path}: {len(entries):,} cameras; 1 to {MOST_CAMERAS:,} are possible", path=str(path))
    cameras = []
    for i, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise SceneError(f"{path.name}, camera {i}: not an object", path=str(path))
        cameras.append(read(entry, found, f"{path.name}, camera {i}"))
    return CameraFile(cameras, fps)


def _listed_camera(entry: dict[str, Any], _: Any, place: str) -> Camera:
    width, height = (_pixels(entry, key, place) for key in ("width", "height"))
    fx, fy = (_number(entry, key, place, low=1e-3, high=1e7) for key in ("fx", "fy"))
    cx, cy = (
        _number(entry, key, place, low=-1e6, high=1e6) if key in entry else side / 2
        for key, side in (("cx", width), ("cy", height))
    )
    center = _array(entry, "position", (3,), place)
    to_world = _rotation(_array(entry, "rotation", (3, 3), place), f"{place}: 'rotation'")
    return _camera(width, height, fx, fy, cx, cy, center, to_world)


def _path_camera(entry: dict[str, Any], whole: dict[str, Any], place: str) -> Camera:
    width, height = (_pixels(whole, key, place) for key in ("render_width", "render_height"))
    fov = _number(entry, "fov", place, low=1e-2, high=179)
    focal = height / (2 * math.tan(math.radians(fov) / 2))
    matrix = _array(entry, "camera_to_world", (16,), place).reshape(4, 4)
    to_world = _rotation(matrix[:3, :3], f"{place}: 'camera_to_world'") * np.array([1.0, -1.0, -1.0])
    return _camera(width, height, focal, focal, width / 2, height / 2, matrix[:3, 3], to_world)


def _camera(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float,
    center: NDArray[np.float64], to_world: NDArray[np.float64],
) -> Camera:  # fmt: skip
    R, tau = np.ascontiguousarray(to_world.T), -to_world.T @ center
    return Camera(width, height, fx, fy, cx, cy, torch.from_numpy(R).float(), torch.from_numpy(tau).float())


def _rotation(matrix: NDArray[np.float64], place: str) -> NDArray[np.float64]:
    """Return the nearest rotation [3,3] of a nearly orthonormal matrix. Raises SceneError for any other matrix."""
    if abs(matrix @ matrix.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(matrix) <= 0:
        raise SceneError(f"{place} is no rotation")
    u, _, v = np.linalg.svd(matrix)
    nearest: NDArray[np.float64] = u @ v
    return nearest


def _array(entry: dict[str, Any], key: str, shape: tuple[int, ...], place: str) -> NDArray[np.float64]:
    try:
        found = np.array(entry.get(key), dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        found = np.empty(0)
    if found.shape != shape or not (abs(found) < 1e12).all():
        raise SceneError(f"{place}: '{key}' must be {list(shape)} finite numbers")
    return found


def _number(entry: dict[str, Any], key: str, place: str, *, low: float, high: float) -> float:
    value = entry.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
        raise SceneError(f"{place}: '{key}' must be a number in {low:g} .. {high:g}, got {value!r:.40}")
    return float(value)


def _pixels(entry: dict[str, Any], key: str, place: str) -> int:
    return round(_number(entry, key, place, low=1, high=LARGEST_SIDE))
