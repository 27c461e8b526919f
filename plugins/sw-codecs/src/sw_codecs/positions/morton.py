"""Morton (Z-order) codes of integer points: bit i of x, y, z becomes bit 3i, 3i+1, 3i+2."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from sw_gaussians.morton import BITS as MAX_BITS
from sw_gaussians.morton import interleave as interleave

_EVERY_THIRD = 0x1249249249249249
_GATHER = (
    (2, 0x10C30C30C30C30C3),
    (4, 0x100F00F00F00F00F),
    (8, 0x1F0000FF0000FF),
    (16, 0x1F00000000FFFF),
    (32, 0x1FFFFF),
)


def check_points(points: npt.ArrayLike, bits: int) -> np.ndarray:
    """points as int64 [N,3]. Raises ValueError unless they are integers with 0 <= p < 2^bits, bits in 1..21."""
    array = np.asarray(points)
    if not 1 <= bits <= MAX_BITS:
        raise ValueError(f"{bits} bits an axis, must be 1..{MAX_BITS}")
    if array.ndim != 2 or array.shape[1] != 3 or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"points must be integers [N, 3], not {array.dtype} {list(array.shape)}")
    if array.size and (array.min() < 0 or array.max() >= 1 << bits):
        raise ValueError(f"points lie in {array.min()}..{array.max()}, must lie in 0..{(1 << bits) - 1}")
    return array.astype(np.int64)


def encode(points: np.ndarray) -> np.ndarray:
    """Morton codes int64 [N] of points [N,3], 0 <= p < 2^21."""
    codes: np.ndarray = interleave(np.asarray(points, np.int64))
    return codes


def decode(codes: np.ndarray) -> np.ndarray:
    """Points int64 [N,3] of Morton codes [N]."""
    gathered = np.stack([np.asarray(codes, np.int64) >> axis for axis in range(3)], 1) & _EVERY_THIRD
    for shift, mask in _GATHER:
        gathered = (gathered | (gathered >> shift)) & mask
    return gathered


def sort(points: np.ndarray) -> np.ndarray:
    """Indices int64 [N] that bring points [N,3] into Morton order; equal points keep their order."""
    return np.argsort(encode(points), kind="stable")


def sorted_codes(points: npt.ArrayLike, bits: int) -> np.ndarray:
    """Morton codes of points that must be in Morton order already. Raises ValueError if they are not."""
    codes = encode(check_points(points, bits))
    if (np.diff(codes) < 0).any():
        raise ValueError(
            "points are not in Morton order: reorder them and their attributes with sw_codecs.positions.morton.sort"
        )
    return codes
