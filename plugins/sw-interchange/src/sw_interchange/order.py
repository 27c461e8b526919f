"""Morton order: Gaussians that lie together in space stand together in the file."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from sw_gaussians.morton import interleave

from sw_interchange.bands import Array

BITS = 10
CROWD = 256
"""Points of one code that are ordered again, within their own bounds."""


def morton_order(means: Array) -> npt.NDArray[np.intp]:
    """The rows [N] along a Z-order curve, x lowest; points that share a cell are ordered within it."""
    codes = _codes(means)
    order = np.argsort(codes, kind="stable")
    sorted_codes = codes[order]
    starts = np.flatnonzero(np.r_[True, sorted_codes[1:] != sorted_codes[:-1]])
    ends = np.r_[starts[1:], len(order)]
    for start, end in zip(starts, ends, strict=True):
        if end - start > CROWD and len(starts) > 1:
            crowd = order[start:end]
            order[start:end] = crowd[morton_order(means[crowd])]
    return order


def _codes(means: Array) -> npt.NDArray[np.int64]:
    low, high = means.min(0), means.max(0)
    span = high - low
    scale = np.divide(1 << BITS, span, out=np.zeros(3, np.float64), where=span > 0)
    cells = np.minimum(((means - low) * scale), (1 << BITS) - 1).astype(np.int64)
    codes: npt.NDArray[np.int64] = interleave(cells)
    return codes
