"""Encodings of the properties of a .rad chunk: planes of numbers, deflated.

A property of n rows and d numbers is d planes of n values: all x, then all y. Source: the format's description in
Spark's repository, June 2026.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError
from sw_interchange.bands import Array

Planes = npt.NDArray[np.uint8]

BYTES = {
    "f32": 4, "f16": 2, "f32_lebytes": 4, "f16_lebytes": 2, "r8": 1, "r8_delta": 1, "s8": 1, "s8_delta": 1, "ln_f16": 2,
    "ln_0r8": 1, "oct88r8": 3, "u8": 1, "u16": 2, "u32": 4,
}  # fmt: skip
"""Bytes of a number, of `oct88r8` those of a rotation."""
WHOLE = ("u8", "u16", "u32")
LARGEST = 1e30


def inflated(data: memoryview, size: int, name: str) -> bytes:
    """Inflate raw DEFLATE, zlib or gzip to exactly `size` bytes, never more. Raises BitstreamError."""
    reason = "it is damaged"
    # Raw comes first: that is what writers make. A zlib header is a valid start of nothing that long.
    for wbits in (31,) if bytes(data[:2]) == b"\x1f\x8b" else (-15, 15):
        decoder = zlib.decompressobj(wbits)
        try:
            content = decoder.decompress(data, size + 1)
        except zlib.error as error:
            reason = str(error)
            continue
        if len(content) == size:
            return content
        reason = f"it unpacks to {'more than' if len(content) > size else 'fewer than'} {size:,} bytes"
    raise BitstreamError(f"{name}: {reason}")


def decoded(content: bytes, encoding: str, rows: int, told: dict[str, Any], name: str) -> Array:
    """Return the numbers [rows,d] of a property.

    told    the property's description: `min`, `max` where the encoding needs them

    Raises BitstreamError.
    """
    if encoding == "oct88r8":
        return _rotations(np.frombuffer(content, np.uint8).reshape(rows, 3))
    size = BYTES[encoding]
    planes = np.frombuffer(content, np.uint8)
    if encoding.endswith("_lebytes"):
        planes = planes.reshape(size, -1).T.ravel()  # byte after byte of each value again
        encoding = encoding.removesuffix("_lebytes")
    values = _decoders(told, name)[encoding](planes)
    return np.ascontiguousarray(values.reshape(-1, rows).T, np.float32)


def whole_numbers(content: bytes, encoding: str) -> npt.NDArray[np.int64]:
    """Return the integers [rows] of a property of one plane."""
    return np.frombuffer(content, f"<u{BYTES[encoding]}").astype(np.int64)


def _decoders(told: dict[str, Any], name: str) -> dict[str, Callable[[Planes], Any]]:
    def bound(key: str) -> float:
        value = told.get(key)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not abs(value) <= LARGEST:
            raise BitstreamError(f"{name}: its '{key}' is no number")
        return float(value)

    def ranged(codes: Planes) -> Any:
        low, high = bound("min"), bound("max")
        return low + codes / 255.0 * (high - low)

    def logarithm(codes: Planes) -> Any:
        low, high = bound("min"), bound("max")
        return np.where(codes == 0, 0.0, np.exp(low + (codes - 1.0) * (high - low) / 254))

    def summed(codes: Planes) -> Planes:
        rows = told["rows"]
        return np.cumsum(codes.reshape(-1, rows), axis=1, dtype=np.uint8).ravel()

    return {
        "f32": lambda planes: planes.view("<f4"),
        "f16": lambda planes: planes.view("<f2").astype(np.float32),
        "ln_f16": lambda planes: np.exp(planes.view("<f2").astype(np.float32)),
        "r8": ranged,
        "r8_delta": lambda planes: ranged(summed(planes)),
        "s8": lambda planes: planes.view(np.int8) / 127.0 * bound("max"),
        "s8_delta": lambda planes: summed(planes).view(np.int8) / 127.0 * bound("max"),
        "ln_0r8": logarithm,
        "u8": lambda planes: planes,
        "u16": lambda planes: planes.view("<u2"),
        "u32": lambda planes: planes.view("<u4"),
    }


def _rotations(codes: Planes) -> Array:
    """Quaternions x,y,z,w of an axis on the octahedron, 8 bits a coordinate, and a half turn in 8 bits."""
    u, v = (codes[:, i] / 127.5 - 1 for i in (0, 1))
    z = 1 - np.abs(u) - np.abs(v)
    folded = np.maximum(-z, 0)
    axis = np.stack([u - np.copysign(folded, u), v - np.copysign(folded, v), z], axis=1)
    axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-12)
    half = codes[:, 2:] / 255 * np.pi / 2
    return np.concatenate([axis * np.sin(half), np.cos(half)], axis=1).astype(np.float32)
