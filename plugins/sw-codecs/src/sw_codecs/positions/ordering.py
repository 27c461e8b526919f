"""The order in which points are stored: along a Morton curve, so that neighbours in space are neighbours.

The order of a set of points carries log2(n!) bits that nobody needs (15 bits per point at n = 1e5), and what differs
little from row to row codes shorter. Source: specification of the codec library, point positions.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from sw_codecs.positions import morton

Points = TypeVar("Points", np.ndarray, Tensor)


def spatial_order(points: Points, *, bits: int = morton.MAX_BITS) -> Points:
    """Indices int64 [N] that bring `points` into Morton order; equal cells keep their order.

    points  [N, 3], array or tensor on any device. Integers are cells, 0 <= p < 2^bits. Floats are put on a grid of
            2^bits cells along the longest side of their bounding box
    bits    1..21 an axis

    The result is of the kind and on the device of `points`. Raises ValueError for other shapes, integers out of range
    and floats that are not finite.
    """
    if not 1 <= bits <= morton.MAX_BITS:
        raise ValueError(f"{bits} bits an axis, must be 1..{morton.MAX_BITS}")
    given = points.detach() if isinstance(points, Tensor) else np.asarray(points)
    if given.ndim != 2 or given.shape[1] != 3:
        raise ValueError(f"points must be [N, 3], not {list(given.shape)}")
    cells = _cells(given, bits)
    order = torch.argsort(morton.interleave(cells), stable=True)
    return order if isinstance(points, Tensor) else order.numpy()


def box_cells(points: np.ndarray, bits: int = morton.MAX_BITS) -> np.ndarray:
    """Cells int64 [N, 3] in 0..2^bits - 1 of float `points` [N, 3]: each axis of their box is divided alone."""
    if not len(points):
        return np.zeros((0, 3), np.int64)
    exact = points.astype(np.float64)
    low = exact.min(0)
    width = np.maximum(exact.max(0) - low, 1e-300)
    cells: np.ndarray = ((exact - low) / width * ((1 << bits) - 1)).astype(np.int64)
    return cells


def _cells(points: np.ndarray | Tensor, bits: int) -> Tensor:
    """int64 [N, 3] in 0..2^bits - 1."""
    if isinstance(points, Tensor):
        is_float, tensor = points.is_floating_point(), points
    else:
        is_float = points.dtype.kind == "f"
        tensor = torch.from_numpy(points.astype(np.float64 if is_float else np.int64))
    if not len(tensor):
        return tensor.long()
    if not is_float:
        tensor = tensor.long()
        if int(tensor.min()) < 0 or int(tensor.max()) >= 1 << bits:
            raise ValueError(f"cells {int(tensor.min())}..{int(tensor.max())} leave 0..{(1 << bits) - 1}")
        return tensor
    tensor = tensor.double() / 2  # two float64 may be further apart than the largest float64
    if not bool(torch.isfinite(tensor).all()):
        raise ValueError("points hold values that are not finite")
    low = tensor.amin(0)
    width = float((tensor.amax(0) - low).max())
    top = (1 << bits) - 1
    return ((tensor - low) * (top / width) if width > 0 else torch.zeros_like(tensor)).long().clamp(0, top)
