"""Copies a COLMAP scene with lens distortion to a pinhole one.

Pictures are resampled by pycolmap and cut so that no pixel of a black border is left; poses and points stay.
"""

from __future__ import annotations

import importlib
import math
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatwizard_core.api import CapabilityError, SceneError, track
from splatwizard_core.tooling import new_folder
from sw_datasets.loaders.colmap import MAX_SIDE, PLAIN_FOCALS, RADIAL_FOCALS, mask_files, model_folder
from sw_datasets.loaders.colmap_model import ColmapCamera, ColmapImage, ColmapModel, read_model, write_model
from sw_datasets.picture_names import find_pictures
from sw_datasets.pictures import FORMATS, load_mask, load_picture, picture_header

SMALLEST_SHARE = 0.5
"""Of the undistorted picture that must survive when black corners are cut off; less means broken coefficients."""

Size = tuple[int, int]


@dataclass(frozen=True)
class Undistorted:
    """Counts of what was written: images in all, how many of them were resampled, masks, cameras, points."""

    images: int
    undistorted: int
    masks: int
    cameras: int
    points: int


@dataclass(frozen=True)
class _Lens:
    """Undistortion of the pictures of one size by one camera.

    distorted   pycolmap.Camera of the file's size
    camera      the pinhole camera of the result
    crop        (left, top) in what pycolmap makes, where the result begins
    """

    distorted: Any
    camera: ColmapCamera
    crop: tuple[int, int]


def undistort_scene(scene: Path, out: Path, *, images: str = "images", quality: int = 100) -> Undistorted:
    """Write an undistorted copy of the COLMAP folder `scene` into the new folder `out`: images/, sparse/0/, masks/.

    images      picture folder of `scene` that is used
    quality     of JPEG pictures, 1..100

    Image names, file formats, poses, points and tracks stay; key points move with the pixels (those that no pinhole
    ray reaches are put at -1, -1). A picture becomes 8 bit per channel and keeps its alpha. Cameras of the result have
    the size of the files. Pictures by pinhole cameras are copied.

    Raises SceneError in one line, also where there is nothing to undistort; CapabilityError without pycolmap. `out` is
    whole or not there.
    """
    load_pycolmap()
    if os.path.lexists(out):
        raise SceneError(f"{out} is there already: choose another folder", path=str(out))
    folder = model_folder(scene)
    if folder is None:
        raise SceneError(f"{scene}: no sparse/0/cameras.bin (or .txt): only COLMAP scenes can be undistorted")
    model = read_model(folder)
    for image in model.images.values():
        if image.camera_id not in model.cameras:
            raise SceneError(f"{folder}: image '{image.name}' refers to camera {image.camera_id}, which is not there")
    for camera in model.cameras.values():
        _check(camera, folder)
    if all(is_pinhole(camera) for camera in model.cameras.values()):
        raise SceneError(f"{scene}: every camera is a pinhole already, there is nothing to undistort; use it as it is")
    pictures = scene / images
    if not pictures.is_dir():
        raise SceneError(f"{scene}: the picture folder '{images}' is missing (--images)", path=str(scene))
    records = sorted(model.images.values(), key=lambda image: image.name)
    names = [image.name for image in records]
    files = find_pictures(pictures, names)
    masks = mask_files(scene, names)
    sizes = [picture_header(file)[:2] for file in files]
    lenses = _lenses(model, records, sizes)
    with new_folder(out) as temporary, track("undistort", total=len(records), unit="pictures") as bar:
        moved: dict[int, ColmapImage] = {}
        resampled = 0
        for image, file, mask, size in zip(records, files, masks, sizes, strict=True):
            lens = lenses.get((image.camera_id, size))
            target = temporary / "images" / file.relative_to(pictures)
            mask_target = temporary / "masks" / f"{image.name}.png"
            moved[image.id] = image if lens is None else _moved(image, model.cameras[image.camera_id], lens)
            _resample(file, target, lens, quality)
            if mask is not None:
                _resample_mask(mask, mask_target, lens, size)
            resampled += lens is not None
            bar.advance()
        used = {image.camera_id for image in moved.values()}
        plain = {i: camera for i, camera in model.cameras.items() if i in used and is_pinhole(camera)}
        cameras = plain | {lens.camera.id: lens.camera for lens in lenses.values()}
        in_order = {image_id: moved[image_id] for image_id in model.images}
        write_model(ColmapModel(cameras, in_order, model.points), temporary / "sparse" / "0")
    return Undistorted(len(records), resampled, sum(m is not None for m in masks), len(cameras), len(model.points))


def is_pinhole(camera: ColmapCamera) -> bool:
    """Whether a camera has no distortion: a pinhole model, or one whose coefficients are all 0."""
    focals = PLAIN_FOCALS.get(camera.model) or RADIAL_FOCALS.get(camera.model)
    return focals is not None and not any(camera.params[focals + 2 :])


def load_pycolmap() -> Any:
    """Import pycolmap. Raises CapabilityError that says how to install it."""
    try:
        return importlib.import_module("pycolmap")
    except ImportError as error:
        raise CapabilityError(
            f"undistorting needs the package pycolmap ({error}): pip install 'sw-datasets[pycolmap]'",
            missing=["pycolmap"],
        ) from error


def _check(camera: ColmapCamera, folder: Path) -> None:
    two = camera.model not in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
    makes_sense = all(map(math.isfinite, camera.params)) and min(camera.params[: 1 + two]) > 0
    if not makes_sense or not (0 < camera.width < MAX_SIDE and 0 < camera.height < MAX_SIDE):
        raise SceneError(
            f"{folder}: camera {camera.id} makes no sense: {camera.model}, {camera.width}x{camera.height} px, "
            f"{', '.join(f'{x:g}' for x in camera.params)}"
        )


def _at_size(camera: ColmapCamera, size: Size) -> tuple[str, list[float]]:
    """(model, parameters) of a distorted camera for a file of another size.

    Models of one focal length become the same lens with two: width and height of reduced pictures are rounded apart.
    """
    model, params = camera.model, list(camera.params)
    missing = {"SIMPLE_RADIAL": 3, "RADIAL": 2, "SIMPLE_RADIAL_FISHEYE": 3, "RADIAL_FISHEYE": 2}.get(model)
    if missing is not None:
        params = [params[0], *params, *[0.0] * missing]
        model = "OPENCV_FISHEYE" if model.endswith("FISHEYE") else "OPENCV"
    sx, sy = size[0] / camera.width, size[1] / camera.height
    return model, [params[0] * sx, params[1] * sy, params[2] * sx, params[3] * sy, *params[4:]]


def _lenses(model: ColmapModel, records: list[ColmapImage], sizes: list[Size]) -> dict[tuple[int, Size], _Lens]:
    """A lens for each distorted camera and each size of its files; the first size keeps the camera's id."""
    lenses: dict[tuple[int, Size], _Lens] = {}
    fresh = _unused_ids(model)
    seen: set[int] = set()
    for image, size in zip(records, sizes, strict=True):
        camera = model.cameras[image.camera_id]
        key = (camera.id, size)
        if key not in lenses and not is_pinhole(camera):
            new_id = next(fresh) if camera.id in seen else camera.id
            seen.add(camera.id)
            lenses[key] = _make_lens(camera, size, new_id)
    return lenses


def _unused_ids(model: ColmapModel) -> Iterator[int]:
    last = max(model.cameras)
    while True:
        last += 1
        yield last


def _make_lens(camera: ColmapCamera, size: Size, new_id: int) -> _Lens:
    name, params = _at_size(camera, size)
    distorted = load_pycolmap().Camera(model=name, width=size[0], height=size[1], params=params)
    white, pinhole = _undistort(np.full((size[1], size[0]), 255, np.uint8), distorted)
    # pycolmap keeps out black borders by sampling the edge, which is not enough for lenses that are no ring.
    left, top, right, bottom = full_rectangle(white == 255)
    if (right - left) * (bottom - top) < SMALLEST_SHARE * white.size:
        raise SceneError(
            f"camera {camera.id} ({camera.model}: {', '.join(f'{x:g}' for x in camera.params)}) cannot be undistorted: "
            "less than half of the picture would be left; its coefficients are wrong, or its view is too wide"
        )
    fx, fy, cx, cy = pinhole.params
    result = ColmapCamera(new_id, "PINHOLE", right - left, bottom - top, (fx, fy, cx - left, cy - top))
    return _Lens(distorted, result, (left, top))


def full_rectangle(filled: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """(left, top, right, bottom) of a rectangle in which every pixel is filled, found by cutting off the worst edge.

    filled  [H,W]
    """
    left, top, right, bottom = 0, 0, filled.shape[1], filled.shape[0]
    while right > left and bottom > top:
        part = filled[top:bottom, left:right]
        if part.all():
            break
        edges = [1 - edge.mean() for edge in (part[:, 0], part[0], part[:, -1], part[-1])]
        worst = int(np.argmax(edges))
        if edges[worst] == 0:  # a hole inside: whatever is cut, no edge says where
            return left, top, left, top
        left, top = left + (worst == 0), top + (worst == 1)
        right, bottom = right - (worst == 2), bottom - (worst == 3)
    return left, top, right, bottom


def _undistort(pixels: NDArray[np.uint8], distorted: Any) -> tuple[NDArray[np.uint8], Any]:
    """([H,W] or [H,W,3] undistorted, pycolmap's pinhole camera), with the least picture cut that leaves no black."""
    pycolmap = load_pycolmap()
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = 0.0
    bitmap, camera = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(pixels), distorted)
    return bitmap.to_array(), camera


def _through(lens: _Lens, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """[H,W], [H,W,3] or [H,W,4] as the lens's pinhole camera sees it."""
    if pixels.ndim == 3 and pixels.shape[2] == 4:  # pycolmap knows grey and RGB
        return np.dstack([_through(lens, np.ascontiguousarray(part)) for part in (pixels[..., :3], pixels[..., 3])])
    left, top = lens.crop
    whole, _ = _undistort(pixels, lens.distorted)
    return whole[top : top + lens.camera.height, left : left + lens.camera.width]


def _resample(file: Path, target: Path, lens: _Lens | None, quality: int) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if lens is None:
        shutil.copyfile(file, target)
        return
    with Image.open(file, formats=FORMATS) as picture:
        kind = picture.format
    # As COLMAP writes them: full chroma, and nothing lost where the format allows it.
    known: dict[str | None, dict[str, Any]] = {
        "JPEG": {"quality": quality, "subsampling": 0},
        "WEBP": {"lossless": True},
    }
    Image.fromarray(_through(lens, load_picture(file))).save(target, format=kind, **known.get(kind, {}))


def _resample_mask(mask: Path, target: Path, lens: _Lens | None, size: Size) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    pixels = load_mask(mask, size).astype(np.uint8) * 255
    if lens is not None:
        pixels = (_through(lens, pixels) >= 128).astype(np.uint8) * 255
    Image.fromarray(pixels).save(target, format="PNG")


def _moved(image: ColmapImage, camera: ColmapCamera, lens: _Lens) -> ColmapImage:
    """The image with its key points where the pinhole camera sees them."""
    scale = np.array([lens.distorted.width / camera.width, lens.distorted.height / camera.height])
    xys = np.full((len(image.xys), 2), -1.0)
    if len(xys):
        fx, fy, cx, cy = lens.camera.params
        rays = np.asarray(lens.distorted.cam_from_img(image.xys * scale), dtype=np.float64)
        reached = np.isfinite(rays).all(axis=1)
        xys[reached] = rays[reached] * [fx, fy] + [cx, cy]
    return replace(image, camera_id=lens.camera.id, xys=xys)
