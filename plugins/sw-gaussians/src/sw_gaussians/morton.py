"""Morton (Z-order) codes: bit i of x, y, z becomes bit 3i, 3i+1, 3i+2. Neighbours in space follow each other."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

BITS = 21  # per axis; three axes fill an int64
ROWS_AT_ONCE = 1 << 18  # points whose cells are found together: those of all would be the largest thing in memory
_SPREAD = (
    (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F), (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)  # fmt: skip


@torch.no_grad()
def morton_order(points: Tensor) -> Tensor:
    """Return the rows [N] int64 of points [N,3] in the order of their Morton codes; equal codes keep their order.

    The grid has 2^21 cells an axis of the box around the points. No gradient.
    """
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.int64, device=points.device)
    low, high = points.amin(dim=0), points.amax(dim=0)
    units = (((part - low) / (high - low).clamp_min(1e-30)).double() for part in points.split(ROWS_AT_ONCE))
    codes = torch.cat([interleave((unit * (2**BITS - 1)).long()) for unit in units])
    return torch.argsort(codes, stable=True)


def interleave(cells: Any) -> Any:
    """Return the codes [N] of int64 cells [N,3], 0 <= cell < 2^21: an array for an array, a tensor for a tensor."""
    found = cells[:, 0] | 0  # of its kind, and where it is
    for start in range(0, len(cells), ROWS_AT_ONCE):
        part = cells[start : start + ROWS_AT_ONCE]
        for shift, mask in _SPREAD:
            part = (part | (part << shift)) & mask
        found[start : start + ROWS_AT_ONCE] = part[:, 0] | (part[:, 1] << 1) | (part[:, 2] << 2)
    return found
