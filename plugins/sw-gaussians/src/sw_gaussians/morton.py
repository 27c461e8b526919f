"""Order along a Morton curve: neighbours in space become neighbours in memory."""

from __future__ import annotations

import torch
from torch import Tensor

BITS = 21
"""Bits an axis: three of them fill an int64."""
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
    unit = ((points - low) / (high - low).clamp_min(1e-30)).double()
    cells = (unit * (2**BITS - 1)).long()
    code = sum(_spread(cells[:, axis]) << axis for axis in range(3))
    assert isinstance(code, Tensor)
    return torch.argsort(code, stable=True)


def _spread(x: Tensor) -> Tensor:
    """Put two zero bits behind each of the lowest 21 bits."""
    for shift, mask in _SPREAD:
        x = (x | (x << shift)) & mask
    return x
