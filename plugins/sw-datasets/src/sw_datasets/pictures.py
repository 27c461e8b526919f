"""Picture files: finding them, the size at which they are used, and decoding them to uint8."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from splatwizard_core.api import ConfigError, SceneError

SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"))

FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
"""Formats that are decoded, whatever a file's suffix. Pillow knows more, and for EPS it would start Ghostscript."""

PIXELS_VARIABLE = "SPLATWIZARD_MAX_PIXELS"
MAX_PIXELS = 1 << 26
"""Pixels of the largest picture that is decoded, unless the environment says another number: a file of 6 kB may claim
164 million, and each of several threads then takes gigabytes. Pillow's own limit of 178 million stays."""


def pixel_limit() -> int:
    """Pixels of the largest picture that is decoded. Raises ConfigError if the environment says no such number."""
    text = os.environ.get(PIXELS_VARIABLE) or str(MAX_PIXELS)
    if not text.isdecimal():
        raise ConfigError(f"{PIXELS_VARIABLE} is {text!r}, must be a number of pixels", key=PIXELS_VARIABLE)
    return int(text)


def fitted_size(width: int, height: int, resolution: int) -> tuple[int, int]:
    """The (width, height) a picture is used at, by the rule of the 3DGS code.

    resolution  1, 2, 4, 8: divide by it and round half to even; -1: at most 1600 px wide (only the width is
                tested), truncated; any other number: that many px wide, truncated

    Raises ConfigError for 0 and for negative numbers other than -1.
    """
    if resolution in (1, 2, 4, 8):
        fitted = round(width / resolution), round(height / resolution)
    else:
        if resolution < -1 or resolution == 0:
            raise ConfigError(
                f"resolution {resolution} makes no sense: use -1 (at most 1600 px wide), 1, 2, 4, 8, or a width in px",
                key="resolution",
            )
        target = 1600 if resolution == -1 else resolution
        factor = width / target if resolution != -1 or width > target else 1.0
        fitted = int(width / factor), int(height / factor)
    return max(fitted[0], 1), max(fitted[1], 1)


def is_inside(name: str) -> bool:
    """Whether a relative file name from a stranger's file stays inside the folder it is joined to."""
    path = PurePosixPath(name.replace("\\", "/"))
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts and "\0" not in name


def list_pictures(folder: Path) -> list[str]:
    """Names of all pictures below `folder`, relative to it with forward slashes, sorted.

    Links are followed, but no folder is entered twice: links in a ring would never end.
    """
    found = []
    entered: set[str] = set()
    for root, folders, files in os.walk(folder, followlinks=True):
        real = os.path.realpath(root)
        if real in entered:
            folders.clear()
            continue
        entered.add(real)
        folders.sort()
        for file in files:
            if os.path.splitext(file)[1].lower() in SUFFIXES:
                found.append((Path(root) / file).relative_to(folder).as_posix())
    return sorted(found)


def find_pictures(folder: Path, names: Sequence[str]) -> list[Path]:
    """The file of each name: `folder/name`, or the same stem with another picture suffix.

    Raises SceneError that lists the first five missing, for names that lead out of the folder, and where it is not
    clear which file is meant: two files of one stem, or one file for two names.
    """
    for name in names:
        if not is_inside(name):
            raise SceneError(
                f"image name {name!r} leads out of {folder}; the scene files are damaged", path=str(folder)
            )
    by_stem: dict[str, list[str]] | None = None
    found: list[Path] = []
    missing: list[str] = []
    for name in names:
        path = folder / name
        if not os.path.isfile(path):  # unlike Path.is_file: False, not an error, for a name that is too long
            if by_stem is None:
                by_stem = {}
                for other in list_pictures(folder):
                    by_stem.setdefault(os.path.splitext(other)[0], []).append(other)
            candidates = by_stem.get(os.path.splitext(name)[0], [])
            if not candidates:
                missing.append(name)
                continue
            if len(candidates) > 1:
                raise SceneError(
                    f"{folder}: image '{name}' is not there, and {' and '.join(candidates[:3])} could both stand for "
                    "it; keep one",
                    path=str(folder),
                )
            path = folder / candidates[0]
        found.append(path)
    if missing:
        first = ", ".join(repr(name) for name in missing[:5]) + (", ..." if len(missing) > 5 else "")
        raise SceneError(f"{folder}: {len(missing)} of {len(names)} images are missing: {first}", path=str(folder))
    served: dict[Path, str] = {}
    for name, path in zip(names, found, strict=True):
        if served.setdefault(path, name) != name:
            raise SceneError(
                f"{folder}: {path.name} is the only file for two images, '{served[path]}' and '{name}'",
                path=str(folder),
            )
    return found


def picture_header(path: Path) -> tuple[int, int, bool]:
    """(width, height, has alpha) of a picture file, from its header alone. Raises SceneError if it is no picture."""
    with _opened(path, "not a readable picture") as picture:
        return picture.width, picture.height, _has_alpha(picture)


def load_picture(path: Path, size: tuple[int, int] | None = None, *, alpha: bool = True) -> NDArray[np.uint8]:
    """uint8 [H,W,3], or [H,W,4] with straight alpha if the file has it and `alpha` is True.

    size    (width, height) to resize to, Pillow's bicubic in 8 bit (premultiplied where there is alpha)

    Grey, palette, CMYK and 16-bit pictures are converted; EXIF rotation is ignored, as COLMAP does.
    Raises SceneError if the file cannot be decoded.
    """
    with _opened(path, "the picture cannot be decoded") as opened:
        picture = _to_8bit(opened, keep_alpha=alpha)
    if size is not None and picture.size != size:
        picture = picture.resize(size, Image.Resampling.BICUBIC)
    return np.asarray(picture)


def load_composited(path: Path, size: tuple[int, int], background: int) -> NDArray[np.uint8]:
    """uint8 [H,W,3]: the picture on a grey of `background` (0..255), truncated to 8 bit and then resized to `size`."""
    pixels = load_picture(path)
    if pixels.shape[2] == 4:
        share = pixels / 255.0
        mixed = share[..., :3] * share[..., 3:] + background / 255.0 * (1 - share[..., 3:])
        pixels = (mixed * 255.0).astype(np.uint8)
    picture = Image.fromarray(pixels)
    return np.asarray(picture if picture.size == size else picture.resize(size, Image.Resampling.BICUBIC))


def load_cut_out(path: Path, mask: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """uint8 [H,W,4]: a picture without alpha at `size` = (width, height), opaque where its mask file is set."""
    return np.dstack([load_picture(path, size, alpha=False), 255 * load_mask(mask, size).astype(np.uint8)])


def load_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """bool [H,W]: True where the mask picture is at least half bright, or half opaque if it has alpha.

    size    (width, height) to resize to, nearest neighbour
    """
    with _opened(path, "the mask cannot be decoded") as opened:
        grey = opened.convert("RGBA").getchannel("A") if _has_alpha(opened) else _to_8bit(opened).convert("L")
    if grey.size != size:
        grey = grey.resize(size, Image.Resampling.NEAREST)
    return np.asarray(grey) >= 128


@contextlib.contextmanager
def _opened(path: Path, complaint: str) -> Iterator[Image.Image]:
    """Open a picture file; whatever Pillow raises in the block becomes a SceneError."""
    try:
        with Image.open(path, formats=FORMATS) as picture:
            limit = pixel_limit()
            if picture.width * picture.height > limit:
                raise SceneError(
                    f"{path}: {picture.width}x{picture.height} px, more than the {limit:,} pixels that are decoded: "
                    f"set {PIXELS_VARIABLE} to decode larger pictures (each takes about 16 bytes a pixel)",
                    path=str(path),
                )
            yield picture
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise SceneError(f"{path}: {complaint} ({error})", path=str(path)) from error


def _has_alpha(picture: Image.Image) -> bool:
    # The one transparent value that 16-bit grey may name is lost when it becomes 8 bit.
    keyed = "transparency" in picture.info and not picture.mode.startswith("I")
    return picture.mode in ("RGBA", "LA", "PA", "RGBa", "La") or keyed


def _to_8bit(picture: Image.Image, *, keep_alpha: bool = False) -> Image.Image:
    if picture.mode.startswith("I;16"):
        wide = np.asarray(picture).astype(np.uint16)
        return Image.fromarray((wide >> 8).astype(np.uint8)).convert("RGB")
    if picture.mode in ("I", "F"):  # 32-bit containers of 16-bit grey, or floats in 0..1
        values = np.nan_to_num(np.asarray(picture).astype(np.float64))
        values = values * 255 if picture.mode == "F" else values / 256
        return Image.fromarray(np.clip(values, 0, 255).astype(np.uint8)).convert("RGB")
    if not _has_alpha(picture):
        return picture.convert("RGB")
    with_alpha = picture.convert("RGBA")  # also on the way to RGB: Pillow warns of palettes that lose their alpha
    return with_alpha if keep_alpha else with_alpha.convert("RGB")
