"""Picture files: their headers, the size at which they are used, and decoding them to uint8."""

from __future__ import annotations

import contextlib
import os
import stat
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from PIL.TiffImagePlugin import TiffImageFile

from splatwizard_core.api import ConfigError, SceneError

FORMATS = ("PNG", "JPEG", "TIFF", "BMP", "WEBP")
"""Formats that are decoded, whatever a file's suffix. Pillow knows more, and for EPS it would start Ghostscript."""

UPRIGHT = 1
TURNS = {
    2: Image.Transpose.FLIP_LEFT_RIGHT, 3: Image.Transpose.ROTATE_180, 4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE, 6: Image.Transpose.ROTATE_270, 7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}  # fmt: skip
"""EXIF orientation -> what makes the stored pixels upright; `UPRIGHT` leaves them."""
ORIENTATION = 0x0112  # tag of EXIF

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


class Header(NamedTuple):
    """Facts of a picture file from its header alone.

    width, height   of the stored pixels
    has_alpha
    orientation     of EXIF, 1 to 8: how a viewer turns the stored pixels; 1 where the file does not say
    """

    width: int
    height: int
    has_alpha: bool
    orientation: int = UPRIGHT


def read_header(path: Path) -> Header:
    """Facts of a picture file; no pixel is decoded. Raises SceneError if it is no picture."""
    with _opened(path, "not a readable picture") as picture:
        return Header(picture.width, picture.height, _has_alpha(picture), _orientation(picture))


def picture_header(path: Path) -> tuple[int, int, bool]:
    """(width, height, has alpha) of a picture file, from its header alone. Raises SceneError if it is no picture."""
    return read_header(path)[:3]


def load_picture(
    path: Path, size: tuple[int, int] | None = None, *, alpha: bool = True, turn: int = UPRIGHT
) -> NDArray[np.uint8]:
    """uint8 [H,W,3], or [H,W,4] with straight alpha if the file has it and `alpha` is True.

    size    (width, height) to resize to, Pillow's bicubic in 8 bit (premultiplied where there is alpha)
    turn    EXIF orientation by which the stored pixels are turned; what the file itself says is not looked at

    Grey, palette, CMYK and 16-bit pictures are converted. Raises SceneError if the file cannot be decoded.
    """
    with _opened(path, "the picture cannot be decoded") as opened:
        picture = _to_8bit(opened, keep_alpha=alpha)
    if turn in TURNS:
        picture = picture.transpose(TURNS[turn])
    if size is not None and picture.size != size:
        picture = picture.resize(size, Image.Resampling.BICUBIC)
    return np.asarray(picture)


def load_composited(path: Path, size: tuple[int, int], background: int, *, turn: int = UPRIGHT) -> NDArray[np.uint8]:
    """uint8 [H,W,3]: the picture on a grey of `background` (0..255), truncated to 8 bit and then resized to `size`."""
    pixels = load_picture(path, turn=turn)
    if pixels.shape[2] == 4:
        share = pixels / 255.0
        mixed = share[..., :3] * share[..., 3:] + background / 255.0 * (1 - share[..., 3:])
        pixels = (mixed * 255.0).astype(np.uint8)
    picture = Image.fromarray(pixels)
    return np.asarray(picture if picture.size == size else picture.resize(size, Image.Resampling.BICUBIC))


def load_cut_out(
    path: Path, mask: Path, size: tuple[int, int], *, turn: int = UPRIGHT, mask_turn: int = UPRIGHT
) -> NDArray[np.uint8]:
    """uint8 [H,W,4]: a picture without alpha at `size` = (width, height), opaque where its mask file is set."""
    opaque = load_mask(mask, size, turn=mask_turn)
    return np.dstack([load_picture(path, size, alpha=False, turn=turn), 255 * opaque.astype(np.uint8)])


def load_mask(path: Path, size: tuple[int, int], *, turn: int = UPRIGHT) -> NDArray[np.bool_]:
    """bool [H,W]: True where the mask picture is at least half bright, or half opaque if it has alpha.

    size    (width, height) to resize to, nearest neighbour
    turn    as in `load_picture`
    """
    with _opened(path, "the mask cannot be decoded") as opened:
        grey = opened.convert("RGBA").getchannel("A") if _has_alpha(opened) else _to_8bit(opened).convert("L")
    if turn in TURNS:
        grey = grey.transpose(TURNS[turn])
    if grey.size != size:
        grey = grey.resize(size, Image.Resampling.NEAREST)
    return np.asarray(grey) >= 128


@contextlib.contextmanager
def _opened(path: Path, complaint: str) -> Iterator[Image.Image]:
    """Open a picture file; whatever Pillow raises in the block becomes a SceneError."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # opening a pipe waits for a writer
            raise SceneError(f"{path}: {complaint} (it is no file but a folder, a pipe or a device)", path=str(path))
        with Image.open(path, formats=FORMATS) as picture:
            limit = pixel_limit()
            if picture.width * picture.height > limit:
                raise SceneError(
                    f"{path}: {picture.width}x{picture.height} px, more than the {limit:,} pixels that are decoded: "
                    f"set {PIXELS_VARIABLE} to decode larger pictures (each takes about 16 bytes per pixel)",
                    path=str(path),
                )
            yield picture
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise SceneError(f"{path}: {complaint} ({error})", path=str(path)) from error


def _orientation(picture: Image.Image) -> int:
    """EXIF orientation, where it stands ahead of the pixels: asking Pillow for all of EXIF would decode a PNG.

    That of a TIFF is applied by Pillow itself, to its size and to its pixels.
    """
    if isinstance(picture, TiffImageFile):
        return UPRIGHT
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "Corrupt EXIF data": then the file does not say
            exif = Image.Exif()
            exif.load(picture.info.get("exif", b""))
            said = exif.get(ORIENTATION, UPRIGHT)
        return said if type(said) is int and said in TURNS else UPRIGHT
    except Exception:  # Pillow raises many kinds for damaged EXIF, which is no reason to refuse the picture
        return UPRIGHT


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
