"""COLMAP reconstructions: images/ beside sparse/0/ with cameras, images and points3D as .bin or .txt."""

from __future__ import annotations

import contextlib
import os
import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from splatwizard_core.api import Camera, PointCloud, Scene, SceneError, SceneOptions, View
from sw_datasets.assemble import assemble_scene
from sw_datasets.families import COLMAP
from sw_datasets.image_checks import Gate
from sw_datasets.loaders.colmap_model import ColmapCamera, ColmapImage, ColmapPoints, count_images, read_model
from sw_datasets.picture_names import SUFFIXES, find_pictures, list_pictures, name_key, view_name
from sw_datasets.rules import Rules, rules_for, unused_option_warnings
from sw_datasets.start_points import cloud_beside, points_in_sight_of, read_cloud

PLAIN_FOCALS = {"SIMPLE_PINHOLE": 1, "PINHOLE": 2}
RADIAL_FOCALS = {
    "SIMPLE_RADIAL": 1, "RADIAL": 1, "OPENCV": 2, "FULL_OPENCV": 2, "FOV": 2, "SIMPLE_DIVISION": 1, "DIVISION": 2,
}  # fmt: skip
"""Models that are a pinhole camera when all their coefficients are 0 -> number of focal lengths.

The fisheye models are not: with zero coefficients they are still an equidistant projection.
"""

PANORAMAS = ("EQUIRECTANGULAR",)
"""Models that no undistortion makes a pinhole camera."""

MAX_SIDE = 1 << 24
"""Pixels; wider is a damaged file (text may state any integer, also one that no float can hold)."""


ELSEWHERE = ("colmap/sparse/0", "colmap/sparse", "dense/0/sparse", "dense/sparse", "colmap_text", ".")
"""Folders of models that are not where COLMAP's mapper puts them."""

MaskFinder = Callable[[Path, Sequence[str]], "list[Path | None]"]
"""(scene folder, image names) -> the mask file of each image, None where there is none."""


class ColmapDataset:
    """COLMAP scenes: a sparse model with its pictures; pinhole cameras."""

    def detect(self, path: Path) -> float:
        """0.5 with cameras and images files in sparse/0 or sparse, 0.45 with the cameras alone, 0.3 where both lie in
        the folder itself, else 0."""
        model = model_folder(path)
        if model is None or (model == path and not _has(model, "images")):
            return 0.0
        if model == path:
            return 0.3
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
    picture_folder = rules.images or "images"
    images = sorted(model.images.values(), key=lambda image: image.name)
    if not images:
        raise SceneError(f"{folder}: no registered image; a scene needs at least 2", path=str(path))
    warnings = _other_models(path, folder)
    root = picture_root(path, folder, picture_folder)
    where, names = _existing(root, picture_folder), [image.name for image in images]
    files = find_pictures(where, names, warnings)
    warnings += _unused(where, len(images))
    names = [view_name(name, file, where) for name, file in zip(names, files, strict=True)]
    gate = Gate(path, rules, quiet_masks=masks is not None)
    views = []
    found = (masks or mask_files)(root, names)
    warnings += idle_masks(root, found) if masks is None else []
    for image, name, file, mask in zip(images, names, files, found, strict=True):
        if image.camera_id not in model.cameras:
            raise SceneError(
                f"{folder}: image '{name}' refers to camera {image.camera_id}, which is not in cameras",
                path=str(path),
            )
        intrinsics = model.cameras[image.camera_id]
        fx, fy, cx, cy = pinhole(intrinsics, path)
        R, tau = pose(image)
        camera = Camera(intrinsics.width, intrinsics.height, fx, fy, cx, cy, R, tau)
        picture = gate.admit(name, file, (intrinsics.width, intrinsics.height))
        views.append(gate.view(name, picture, camera, mask))
    warnings += gate.warnings()
    points = point_cloud(model.points) if len(model.points) else None
    of_training: Callable[[Sequence[View]], PointCloud] | None = None
    if points is not None and len(model.points.track):  # of a thinned model the tracks are often gone
        ids = {name: image.id for name, image in zip(names, images, strict=True)}

        def of_training(train: Sequence[View]) -> PointCloud:
            return point_cloud(model.points, {ids[view.name] for view in train})

    if points is None:
        cloud = cloud_beside(folder) or cloud_beside(path)
        if cloud is not None:
            points = read_cloud(cloud)
            warnings.append(f"points3D has no point: {len(points):,} start points are those of {cloud.name}")
    unused = ("legacy_8bit_composite", "init_points") if points is not None else ("legacy_8bit_composite",)
    if points is None:
        of_training = points_in_sight_of(options)
        points = of_training(views)
        warnings.append(
            f"the reconstruction has no 3D points: {options.init_points:,} random ones are laid where the cameras "
            "look (init_points = N)"
        )
    warnings += unused_option_warnings(options, unused, rules.family)
    return assemble_scene(
        path.resolve().name,
        views,
        points=points,
        train_points=of_training,
        protocol=rules.protocol(masked=gate.masked, turned=gate.turned),
        path=str(path),
        warnings=warnings,
        finds_lists=rules.finds_lists,
    )


def model_folder(path: Path) -> Path | None:
    """The folder of the model below `path`; None if there is none.

    sparse/0 or sparse, where COLMAP puts it; else that of sparse/1, sparse/2, ... with the most images; else
    colmap/sparse/0 or colmap/sparse (nerfstudio), dense/0/sparse or dense/sparse (COLMAP's undistorted copy),
    colmap_text (instant-ngp), or the folder itself.
    """
    usual = [path / "sparse" / "0", path / "sparse"]
    numbered = sorted(_numbered(path / "sparse"), key=count_images, reverse=True)
    for folder in (*usual, *numbered, *(path / place for place in ELSEWHERE)):
        if _has(folder, "cameras"):
            return folder
    return None


def picture_root(path: Path, model: Path, pictures: str) -> Path:
    """The folder in which the picture folder lies: the scene, or where a copy has its own, the copy."""
    own = model.parent if model.name == "sparse" else model.parent.parent
    return (
        own
        if own != path and own.is_relative_to(path) and (own / pictures).is_dir() and not (path / pictures).is_dir()
        else path
    )


def _numbered(sparse: Path) -> list[Path]:
    """Models in sparse/0, sparse/1, ..., by number."""
    try:
        with os.scandir(sparse) as entries:
            numbers = sorted(int(each.name) for each in entries if re.fullmatch(r"\d{1,4}", each.name))
    except OSError:
        return []
    return [folder for number in numbers if _has(folder := sparse / str(number), "cameras")]


def _other_models(path: Path, chosen: Path) -> list[str]:
    """Tell of models that are not read: COLMAP makes several where it cannot join all pictures in one."""
    others = [each for each in _numbered(chosen.parent) if each != chosen] if chosen != path else []
    if not others:
        return []
    found = ", ".join(f"{each.relative_to(path).as_posix()} ({count_images(each)} images)" for each in others[:3])
    return [
        f"the model in {chosen.relative_to(path).as_posix()} is read ({count_images(chosen)} images); "
        f"there is also {found}"
    ]


def pinhole(camera: ColmapCamera, scene: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of COLMAP's own image size.

    Raises SceneError for a lens model with distortion, naming it and the command that removes it.
    """
    if camera.model in PANORAMAS:
        raise SceneError(
            f"{scene}: camera {camera.id} is a panorama ({camera.model}), which no pinhole camera can be made of; cut "
            "it into perspective pictures before the poses are made",
            path=str(scene),
        )
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
    """(R [3,3], tau [3]) float64 of a registered image; NaN where the quaternion is zero or not finite."""
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
    return torch.from_numpy(R), torch.tensor(image.tvec, dtype=torch.float64)


def point_cloud(points: ColmapPoints, seen_by: Collection[int] | None = None) -> PointCloud:
    """Points (float64) and colours (float32) of a model; `seen_by`: those that at least one of these images saw."""
    rgb = torch.from_numpy(points.rgb.astype(np.float32) / 255)
    cloud = PointCloud(torch.from_numpy(points.xyz.astype(np.float64)), rgb)
    if seen_by is None:
        return cloud
    by_them = np.concatenate([[0], np.isin(points.track[:, 0], list(seen_by)).cumsum()])  # observations before a row
    kept = torch.from_numpy(np.diff(by_them[points.track_start]) > 0)
    return PointCloud(cloud.xyz[kept], rgb[kept])


def mask_files(path: Path, names: Sequence[str]) -> list[Path | None]:
    """The mask of each image: masks/NAME.png (COLMAP's way), masks/NAME, or masks/STEM.png; also in mask/.

    Else the one picture there of that stem, also with "_mask" or "mask_"; images whose last part no other has may lack
    their folder there.
    """
    folder = _mask_folder(path)
    if folder is None:
        return [None] * len(names)
    there = {name_key(mask): folder / mask for mask in list_pictures(folder)}
    stems: dict[str, list[Path]] = {}
    for key, file in there.items():
        stems.setdefault(os.path.splitext(key)[0], []).append(file)
    keys = [name_key(name) for name in names]
    lasts = Counter(key.rpartition("/")[2] for key in keys)
    found: list[Path | None] = []
    for key in keys:
        last = key.rpartition("/")[2]
        ways = [
            mask for name in ([key, last] if lasts[last] == 1 else [key]) for mask in _mask_names(name, there, stems)
        ]
        found.append(next(iter(ways), None))
    return found


def _mask_names(name: str, there: Mapping[str, Path], stems: Mapping[str, list[Path]]) -> Iterator[Path]:
    """Files that may be the mask of an image, the likeliest first."""
    stem = os.path.splitext(name)[0]
    yield from (there[mask] for mask in (f"{name}.png", name, f"{stem}.png") if mask in there)
    folder, _, last = stem.rpartition("/")
    for each in (name, stem, f"{stem}_mask", f"{folder}/mask_{last}".lstrip("/")):
        if len(files := stems.get(each, [])) == 1:
            yield files[0]


def _mask_folder(path: Path) -> Path | None:
    return next((path / name for name in ("masks", "mask") if (path / name).is_dir()), None)


def idle_masks(path: Path, found: Sequence[Path | None]) -> list[str]:
    """Tell of pictures among the masks that are of no image."""
    folder = _mask_folder(path)
    if folder is None:
        return []
    there, used = len(list_pictures(folder)), len({mask for mask in found if mask is not None})
    return [f"{there - used} of {there} pictures in {folder.name} are the mask of no image"] if there > used else []


def _has(folder: Path, part: str) -> bool:
    return any(os.path.isfile(folder / f"{part}{suffix}") for suffix in (".bin", ".txt"))


def _existing(path: Path, picture_folder: str) -> Path:
    folder = path / picture_folder
    if not folder.is_dir():
        there = sorted((p for p in path.iterdir() if p.is_dir() and _has_pictures(p)),
                       key=lambda p: (not p.name.lower().startswith("images"), p.name))  # fmt: skip
        names = ", ".join(p.name for p in there[:4])
        hint = f"there is {names} (--images {there[0].name})" if there else "no folder beside it holds pictures"
        raise SceneError(f"{path}: the picture folder '{picture_folder}' is missing; {hint}", path=str(path))
    return folder


def _has_pictures(folder: Path) -> bool:
    with contextlib.suppress(PermissionError), os.scandir(folder) as entries:
        return any(os.path.splitext(each.name)[1].lower() in SUFFIXES for each in entries)
    return False


def _unused(folder: Path, registered: int) -> list[str]:
    there = len(list_pictures(folder))
    if there <= registered:
        return []
    return [f"{there - registered} of {there} pictures in {folder.name} have no pose and are not used"]
