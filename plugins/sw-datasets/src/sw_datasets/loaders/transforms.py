"""Files of camera-to-world matrices: the transforms.json of nerfstudio, instant-ngp, Polycam, Metashape, and Blender's.

A file has keys for all frames and a list of `frames`, each with `file_path`, `transform_matrix` and the same keys for
itself alone. Every key is used, refused, or told.
"""

from __future__ import annotations

import json
import math
import os
from collections import ChainMap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from splatwizard_core.api import Camera, PointCloud, Scene, SceneError, SceneOptions, View
from splatwizard_core.tooling import json_reason
from sw_datasets.assemble import assemble_scene
from sw_datasets.families import TRANSFORMS
from sw_datasets.image_checks import Gate
from sw_datasets.loaders.colmap import idle_masks, mask_files
from sw_datasets.name_lists import NameLists
from sw_datasets.picture_names import SUFFIXES, find_each, find_pictures, is_inside, view_name
from sw_datasets.pictures import read_header
from sw_datasets.rules import rules_for, unused_option_warnings
from sw_datasets.start_points import cloud_beside, points_in_sight_of, read_cloud

FILE = "transforms.json"

DISTORTION = frozenset(("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "b1", "b2", "s1", "s2", "s3", "s4"))
PINHOLES = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "PERSPECTIVE", "pinhole")
"""Values of `camera_model`, which some programs write, that are a pinhole camera where all coefficients are 0."""
FLAGS = ("is_fisheye", "is_equirectangular", "is_panorama", "ortho", "is_ortho")
"""Keys that are true of cameras of another kind."""
SPLIT_LISTS = {"train": "train_filenames", "test": "test_filenames", "val": "val_filenames"}
INTRINSICS = frozenset(("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y"))
USED = (
    INTRINSICS
    | DISTORTION
    | {"frames", "file_path", "transform_matrix", "camera_model", "distortion_params", "ply_file_path", "mask_path"}
    | {*FLAGS, *SPLIT_LISTS.values()}
)
HARMLESS = {
    "applied_transform": "poses and points stand as they are in the files",
    "applied_scale": "poses and points stand as they are in the files",
    "aabb_scale": "the scene is not bounded",
    "depth_file_path": "no depth is trained on",
}
"""Keys that are not used -> why that is right; of others it is told that they are not used."""
CONTRADICTION = 0.01
"""Share by which two statements of one focal length may differ."""
LONGEST_KEY = 40


@dataclass
class Frames:
    """The views of one file, and what else it says.

    unused      keys that were not used
    points      start points that it names, if it names any and they are there
    lists       names of views to train and to test, where it has such lists
    """

    views: list[View]
    unused: set[str] = field(default_factory=set)
    cloud: Path | None = None
    lists: NameLists | None = None
    warnings: list[str] = field(default_factory=list)


class TransformsDataset:
    """Scenes of one transforms.json: intrinsics for all frames or for each, split by rule."""

    def detect(self, path: Path) -> float:
        """0.4 with transforms.json, less than a COLMAP model or Blender's pair of files beside it; else 0."""
        return 0.4 if os.path.isfile(path / FILE) else 0.0

    def load(self, path: Path, options: SceneOptions) -> Scene:
        """Read poses and the sizes of the pictures; no pixel is decoded. Raises SceneError in one line."""
        rules = rules_for(TRANSFORMS, path.resolve().name, options)
        gate = Gate(path, rules)
        found = read_frames(path, FILE, gate)
        points, told = start_of(path, found, options)
        warnings = [*found.warnings, *unused_keys(FILE, found.unused), *gate.warnings(), *told]
        unused = ("legacy_8bit_composite",) if found.cloud is None else ("legacy_8bit_composite", "init_points")
        warnings += unused_option_warnings(options, unused, rules.family)
        return assemble_scene(
            path.resolve().name,
            found.views,
            points=points,
            train_points=None if found.cloud is not None else points_in_sight_of(options),
            protocol=rules.protocol("frames", masked=gate.masked, turned=gate.turned),
            path=str(path),
            own_lists=found.lists,
            warnings=warnings,
            finds_lists=rules.finds_lists,
        )


def start_of(path: Path, found: Frames, options: SceneOptions) -> tuple[PointCloud, list[str]]:
    """(start points, warnings): those that the file names, those that lie beside it, or random ones in sight."""
    if found.cloud is None:
        found.cloud = cloud_beside(path)
    if found.cloud is not None:
        points = read_cloud(found.cloud)
        return points, [f"the {len(points):,} start points are those of {found.cloud.name}"]
    return points_in_sight_of(options)(found.views), [
        f"there are no start points: {options.init_points:,} random ones are laid where the cameras look "
        "(init_points = N)"
    ]


def unused_keys(file: str, keys: set[str]) -> list[str]:
    """Name the keys of a file that were not used, in one line."""
    if not keys:
        return []
    names = sorted(keys)
    shown = [f"{name[:LONGEST_KEY]}" + (f" ({HARMLESS[name]})" if name in HARMLESS else "") for name in names[:12]]
    return [f"{file}: not used: {', '.join(shown)}" + (f" and {len(names) - 12} more" if len(names) > 12 else "")]


def read_frames(path: Path, file: str, gate: Gate) -> Frames:
    """The views of one transforms file. Raises SceneError in one line."""
    where = f"{path / file}"
    data = read_json(path / file)
    frames = data.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise SceneError(f"{where}: 'frames' must be a list of objects", path=str(path))
    found = Frames([], unused={key for part in (data, *frames) for key in part if key not in USED})
    names = [_picture_name(path, frame, i, where) for i, frame in enumerate(frames)]
    files = find_pictures(path, names, found.warnings)
    names = [view_name(name, picture, path) for name, picture in zip(names, files, strict=True)]
    masks = _masks(path, frames, names, found.warnings)
    if dynamic := sum((each.parent / f"dynamic_mask_{each.stem}.png").is_file() for each in files):
        found.warnings.append(f"{dynamic} masks dynamic_mask_*.png (instant-ngp) are not used")
    contradicted: list[str] = []
    for frame, name, picture_file, mask in zip(frames, names, files, masks, strict=True):
        merged = ChainMap(frame, data)
        _check_lens(merged, name, where)
        size = _size(merged, name, where, picture_file)
        picture = gate.admit(name, picture_file, size)
        fx, fy, cx, cy = _intrinsics(merged, name, where, (picture.width, picture.height), size, contradicted)
        R, tau = _pose(frame.get("transform_matrix"), name, where)
        camera = Camera(picture.width, picture.height, fx, fy, cx, cy, R, tau)
        found.views.append(gate.view(name, picture, camera, mask))
    if contradicted:
        found.warnings.append(
            f"{file}: focal length and angle contradict each other in {len(contradicted)} images, the first "
            f"{contradicted[0]}: the focal length is taken"
        )
    found.cloud = _named_cloud(path, data.get("ply_file_path"), file, found.warnings)
    lists = {part: _name_list(data[key], key, where) for part, key in SPLIT_LISTS.items() if data.get(key)}
    test = lists.get("test") or lists.get("val")
    if lists.get("train") and test:
        found.lists = NameLists(lists["train"], test, file)
    return found


def read_json(path: Path) -> dict[str, Any]:
    """The object in a file. Raises SceneError."""
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError:
        raise SceneError(f"{path} is missing: {path.parent} is no such scene", path=str(path)) from None
    except (OSError, ValueError, RecursionError) as error:
        raise SceneError(f"{path}: not readable JSON ({json_reason(error)})", path=str(path)) from error
    if not isinstance(data, dict):
        raise SceneError(f"{path}: must hold an object with 'camera_angle_x' and 'frames'", path=str(path))
    return data


def _picture_name(path: Path, frame: Mapping[str, Any], index: int, where: str) -> str:
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise SceneError(f"{where}: frame {index} has no 'file_path'", path=str(path))
    name = name.removeprefix("./")
    # As the data set has it, without a suffix; a picture that has one and is gone may have been converted.
    bare = os.path.splitext(name)[1].lower() not in SUFFIXES and not os.path.isfile(path / name)
    return name + ".png" if bare else name


def _name_list(names: Any, key: str, where: str) -> tuple[str, ...]:
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{where}: '{key}' must be a list of file names")
    return tuple(names)


def _masks(path: Path, frames: list[Any], names: list[str], warnings: list[str]) -> list[Path | None]:
    """The mask of each frame: its `mask_path`, else one beside, as in COLMAP scenes."""
    masks = mask_files(path, names)
    told = {i: frame["mask_path"] for i, frame in enumerate(frames) if isinstance(frame.get("mask_path"), str)}
    told = {i: name.removeprefix("./") for i, name in told.items() if name}
    found = find_each(path, list(told.values()))
    for i, mask in zip(told, found, strict=True):
        masks[i] = mask or masks[i]
    warnings += idle_masks(path, masks)
    if missing := found.count(None):
        warnings.append(f"{missing} masks that 'mask_path' names are not there")
    return masks


def _named_cloud(path: Path, named: Any, file: str, warnings: list[str]) -> Path | None:
    if named is None:
        return None
    if isinstance(named, str) and is_inside(named) and os.path.isfile(path / named):
        return path / named
    last = named.replace("\\", "/").rpartition("/")[2] if isinstance(named, str) else ""
    if last and os.path.isfile(path / last):
        return path / last
    warnings.append(f"{file}: ply_file_path {str(named)[:80]!r} is not there")
    return None


def _check_lens(values: Mapping[str, Any], name: str, where: str) -> None:
    """Raise SceneError for a camera that is no pinhole."""
    model, flags = values.get("camera_model"), [flag for flag in FLAGS if values.get(flag)]
    if model not in (None, *PINHOLES) or flags:
        what = flags[0] if model in (None, *PINHOLES) else f"camera_model {str(model)[:40]!r}"
        raise SceneError(
            f"{where}: image '{name}' is of a camera of another kind ({what}); 3DGS needs pinhole images: undistort "
            "them"
        )
    several = values.get("distortion_params")
    numbers = several if isinstance(several, list) else [] if several is None else [several]
    lens = [_number(number, "distortion_params", name, where) for number in numbers]
    lens += [_number(values[key], key, name, where) for key in sorted(DISTORTION) if values.get(key) is not None]
    if any(lens):
        raise SceneError(
            f"{where}: image '{name}' has lens distortion (k1 to k6, p1, p2, distortion_params ...); undistort its "
            "pictures and strike the coefficients out (sw data undistort does it for COLMAP scenes)"
        )


def _number(value: Any, key: str, name: str, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise SceneError(f"{where}: '{key}' of image '{name}' is {value!r:.60}, not a number")
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _size(values: Mapping[str, Any], name: str, where: str, picture: Path) -> tuple[int, int] | None:
    """(w, h) that the intrinsics were made for; None where the file does not say.

    Of one side alone the other follows from the picture's aspect.
    """
    told = [_number(values[key], key, name, where) for key in ("w", "h") if values.get(key) is not None]
    if not told:
        return None
    if len(told) == 1:
        header = read_header(picture)
        aspect = header.height / header.width
        told = [told[0], told[0] * aspect] if values.get("w") is not None else [told[0] / aspect, told[0]]
    if not all(1 <= side < 1 << 24 for side in told):
        raise SceneError(f"{where}: w and h of image '{name}' are {told[0]:g} and {told[1]:g} px")
    return round(told[0]), round(told[1])


def _intrinsics(
    values: Mapping[str, Any],
    name: str,
    where: str,
    file_size: tuple[int, int],
    size: tuple[int, int] | None,
    contradicted: list[str],
) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of the file: from fl_x and fl_y (scaled from w, h if given), else from the angles.

    Square pixels unless fl_y or camera_angle_y says otherwise. Where focal length and angle contradict each other, the
    length is taken, and `contradicted` gets both.
    """
    width, height = file_size
    w, h = size or file_size
    told = {key: _number(values[key], key, name, where) for key in INTRINSICS if values.get(key) is not None}
    from_angle: dict[str, float] = {}
    for key, side in (("camera_angle_x", w), ("camera_angle_y", h)):
        if key in told:
            if not 0 < told[key] < math.pi:
                raise SceneError(f"{where}: {key} is {told[key]}, must lie between 0 and pi radians")
            from_angle[key] = side / (2 * math.tan(told[key] / 2))
    for key, angle in (("fl_x", "camera_angle_x"), ("fl_y", "camera_angle_y")):
        if key in told and angle in from_angle and not _close(told[key], from_angle[angle]):
            contradicted.append(f"'{name}' {key} = {told[key]:g} and {angle} = {told[angle]:g}")
    fx = told.get("fl_x", from_angle.get("camera_angle_x"))
    fy = told.get("fl_y", from_angle.get("camera_angle_y"))
    if fx is None and fy is None:
        raise SceneError(f"{where}: neither 'camera_angle_x' nor 'fl_x' is given for image '{name}'")
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    assert fx is not None
    assert fy is not None
    if not (fx > 0 and fy > 0):
        raise SceneError(f"{where}: the focal lengths of image '{name}' are {fx:g} and {fy:g} px: they make no sense")
    sx, sy = width / w, height / h
    return fx * sx, fy * sy, told.get("cx", w / 2) * sx, told.get("cy", h / 2) * sy


def _close(a: float, b: float) -> bool:
    return abs(a - b) <= CONTRADICTION * max(abs(a), abs(b))


def _pose(matrix: Any, name: str, where: str) -> tuple[torch.Tensor, torch.Tensor]:
    """(R [3,3], tau [3]) float64, world to camera, from a camera-to-world matrix in OpenGL axes."""
    try:
        c2w = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        c2w = np.empty(0)
    if c2w.shape not in ((4, 4), (3, 4)):
        raise SceneError(f"{where}: 'transform_matrix' of image '{name}' is not a 4x4 matrix")
    if not np.isfinite(c2w).all():
        raise SceneError(f"{where}: the pose of image '{name}' is not finite (NaN or infinite)")
    if c2w.shape == (4, 4) and np.abs(c2w[3] - (0, 0, 0, 1)).max() > 1e-6:
        row = ", ".join(f"{value:g}" for value in c2w[3])
        raise SceneError(
            f"{where}: the last row of 'transform_matrix' of image '{name}' is {row}, not 0, 0, 0, 1: is it transposed?"
        )
    R = (c2w[:3, :3] * np.array([1.0, -1.0, -1.0])).T  # OpenGL looks along -z with y up; ours +z, y down
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise SceneError(f"{where}: 'transform_matrix' of image '{name}' is not a rotation and a translation")
    return torch.from_numpy(R), torch.from_numpy(-R @ c2w[:3, 3])
