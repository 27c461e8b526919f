"""Morton (Z) order: the order in which position codecs return integer points, and so that of all attributes."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

MAX_BITS = 21

# Shift and mask of each halving step that spreads 21 bits to every third one of 63.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_codes(points: NDArray[Any]) -> NDArray[np.int64]:
    """Codes [N] int64 of points [N,3], integers in 0 .. 2^21 - 1; bit i of x, y, z goes to bits 3i, 3i+1, 3i+2."""
    codes = np.zeros(len(points), dtype=np.int64)
    for axis in range(3):
        spread = points[:, axis].astype(np.int64)
        for shift, mask in _SPREAD:
            spread = (spread | (spread << shift)) & mask
        codes |= spread << axis
    return codes


def morton_order(points: NDArray[Any]) -> NDArray[np.int64]:
    """Row indices [N] that sort points [N,3] by Morton code; equal points keep their order."""
    return np.argsort(morton_codes(points), kind="stable")
