"""Lossless WebP images of bytes: their size is read from the header before anything is decoded."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError, CapabilityError

Pixels = npt.NDArray[np.uint8]

LARGEST_SIDE = 16383


def image_size(data: bytes, name: str) -> tuple[int, int]:
    """Width and height that a lossless WebP file claims. Raises BitstreamError for any other file."""
    if len(data) < 25 or data[:4] != b"RIFF" or data[8:12] != b"WEBP":
        raise BitstreamError(f"{name}: not a WebP image")
    at, canvas = 12, None
    while at + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, at)
        body = data[at + 8 : at + 18]
        at += 8 + length + length % 2
        if kind == b"VP8X" and len(body) == 10 and canvas is None:
            canvas = 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
        elif kind == b"VP8L" and len(body) >= 5 and body[0] == 0x2F:
            bits = int.from_bytes(body[1:5], "little")
            size = 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
            if canvas not in (None, size):
                break
            return size
        elif kind in (b"VP8 ", b"ANIM", b"ANMF", b"VP8L", b"VP8X"):
            break
    raise BitstreamError(f"{name}: not one lossless WebP image: numbers in a lossy one are lost")


def decode_image(data: bytes, name: str) -> Pixels:
    """[H,W,4] RGBA of a file whose size was checked with `image_size`. Raises BitstreamError."""
    image = _pillow()
    try:
        with image.open(io.BytesIO(data), formats=["WEBP"]) as picture:
            return np.asarray(picture.convert("RGBA"))
    except Exception as error:  # Pillow raises many kinds for damaged files
        raise BitstreamError(f"{name}: a damaged WebP image: {error}") from error


def encode_image(pixels: Pixels, effort: int) -> bytes:
    """Encode [H,W,3|4] bytes, every one exactly, colours under alpha 0 included.

    effort  0 (quick) .. 6 (small)
    """
    buffer = io.BytesIO()
    _pillow().fromarray(pixels).save(buffer, "WEBP", lossless=True, exact=True, method=effort, quality=50)
    return buffer.getvalue()


def tiled(columns: Sequence[Pixels], width: int, height: int) -> Pixels:
    """[H,W,C] image of channels [N], row by row from the top left, the rest 0."""
    image = np.zeros((width * height, len(columns)), np.uint8)
    for channel, column in enumerate(columns):
        image[: len(column), channel] = column
    return image.reshape(height, width, len(columns))


def _pillow() -> Any:
    from PIL import Image, features

    if not features.check("webp"):
        raise CapabilityError("this Pillow knows no WebP, which .sog files are made of: pip install -U pillow")
    return Image
