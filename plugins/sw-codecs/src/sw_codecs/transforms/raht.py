"""RAHT, the region-adaptive hierarchical transform: an orthonormal Haar transform over the voxels of an octree.

Source: de Queiroz and Chou, Compression of 3D Point Clouds Using a Region-Adaptive Hierarchical Transform (IEEE TIP
2016); as MesonGS (arXiv 2409.09756) applies it to Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatwizard_core.api import ShapeError
from sw_codecs.bits.packing import bit_length

TILE = 1 << 16
"""Numbers of a tile on the CPU."""


@dataclass(frozen=True)
class Merge:
    """All pairs of nodes that merge at one bit of the codes, P of them: of each the left node, then the right one.

    rows        [2 P] int64, row of the first leaf of the node
    partners    [2 P] int64, that of the other node
    a, b        [2 P, 1] float, sqrt(w / (w + v)) and sqrt(v / (w + v)) of their numbers of leaves w and v; b of the
                right one is negative
    """

    rows: Tensor
    partners: Tensor
    a: Tensor
    b: Tensor


class RahtPlan:
    """Pairs and weights of the transform over M voxels: a function of their Morton codes alone, made once.

    codes   [M] integers, ascending, each once, 0 <= code < 2^63

    Two nodes whose codes agree but for the lowest bit merge, bit after bit. Of their vectors c and d, w and v leaves,

        low  = (sqrt(w) c + sqrt(v) d) / sqrt(w + v)      goes on, in the row of c
        high = (sqrt(w) d - sqrt(v) c) / sqrt(w + v)      stays, in the row of d

    so that row 0 ends as sum / sqrt(M) and row i > 0 as the coefficient of the node that voxel i begins. Weights come
    from integers in float64; in float64 on the CPU the transform is +, -, *, / and square roots in a fixed order, and
    gives the same values on every machine. Raises ValueError for codes out of order.
    """

    def __init__(self, codes: npt.ArrayLike) -> None:
        ascending = np.asarray(codes)
        if ascending.ndim != 1 or ascending.dtype.kind not in "iu":
            raise ValueError(f"codes must be integers [M], not {ascending.dtype} {list(ascending.shape)}")
        if (ascending[1:] <= ascending[:-1]).any() or (len(ascending) and int(ascending[0]) < 0):
            raise ValueError("codes must be ascending, each once, and none negative")
        self.size = len(ascending)
        self._merges = _merges(ascending.astype(np.uint64))
        self._moved: dict[tuple[torch.device, torch.dtype], list[Merge]] = {}

    def merges(self, device: torch.device, dtype: torch.dtype) -> list[Merge]:
        """Return the levels from the leaves up, with tensors on `device` and weights of `dtype`; kept."""
        key = (device, dtype)
        if key not in self._moved:
            self._moved[key] = [
                Merge(m.rows.to(device), m.partners.to(device), m.a.to(device, dtype), m.b.to(device, dtype))
                for m in self._merges
            ]
        return self._moved[key]

    def forward(self, values: Tensor) -> Tensor:
        """Return the coefficients [M, C] of `values` [M, C], float32 or float64; differentiable."""
        return _Raht.apply(self._checked(values), self, False)

    def inverse(self, coefficients: Tensor) -> Tensor:
        """Return the values [M, C] of `coefficients` [M, C], float32 or float64; differentiable."""
        return _Raht.apply(self._checked(coefficients), self, True)

    def _checked(self, rows: Tensor) -> Tensor:
        if rows.ndim != 2 or len(rows) != self.size:
            raise ShapeError(f"the transform is over {self.size} voxels, got {list(rows.shape)}")
        return rows


def _merges(codes: npt.NDArray[np.uint64]) -> list[Merge]:
    """Levels from the leaves up; those without a pair are left out.

    Voxel i begins the right node of exactly one pair: at the highest bit in which its code differs from the one before.
    """
    if len(codes) < 2:
        return []
    bit = (bit_length(codes[1:] ^ codes[:-1]) - 1).astype(np.uint64)
    one = np.uint64(1)
    first = (codes[1:] >> (bit + one)) << (bit + one)  # smallest code of the parent node
    after = ((codes[1:] >> bit) + one) << bit  # 2^63 at most: it fits
    row = np.arange(1, len(codes))
    left = np.searchsorted(codes, first)
    w, v = row - left, np.searchsorted(codes, after) - row
    total = (w + v).astype(np.float64)
    a, b = np.sqrt(w / total), np.sqrt(v / total)
    order = np.argsort(bit, kind="stable")
    borders = np.flatnonzero(np.diff(bit[order])) + 1

    def levels(of_left: npt.NDArray[Any], of_right: npt.NDArray[Any], *tail: int) -> list[Tensor]:
        both = np.stack([of_left, of_right], 1)[order]
        return [torch.from_numpy(part.reshape(-1, *tail)) for part in np.split(both, borders)]

    each = levels(left, row), levels(row, left), levels(a, a, 1), levels(b, -b, 1)
    return [Merge(*level) for level in zip(*each, strict=True)]


class _Raht(torch.autograd.Function):
    """The transform is orthonormal: the gradient of one direction is the other one."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, plan: RahtPlan, back: bool) -> Tensor:
        ctx.plan, ctx.back = plan, back
        return _transformed(rows, plan, back)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return _transformed(grad, ctx.plan, not ctx.back), None, None


def _transformed(values: Tensor, plan: RahtPlan, back: bool) -> Tensor:
    found = values.detach().clone(memory_format=torch.contiguous_format)
    merges = plan.merges(found.device, found.dtype)
    most = max((len(merge.rows) for merge in merges), default=0)
    if found.device.type == "cpu":
        # Tiles that a cache holds, in buffers made once: 2.8 times as fast as whole levels (benchmarks/raht.py).
        most = min(most, 2 * max(TILE // max(found.shape[1], 1), 1))
    own, other = found.new_empty(2, most, found.shape[1])
    for merge in reversed(merges) if back else merges:
        for start in range(0, len(merge.rows), most):
            part = slice(start, start + most)
            rows = merge.rows[part]
            x, y = own[: len(rows)], other[: len(rows)]
            torch.index_select(found, 0, rows, out=x)
            torch.index_select(found, 0, merge.partners[part], out=y)
            # No product is fused with the sum: all machines agree.
            x.mul_(merge.a[part])
            y.mul_(merge.b[part])
            found.index_copy_(0, rows, x.sub_(y) if back else x.add_(y))
    return found
