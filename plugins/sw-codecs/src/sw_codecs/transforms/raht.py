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

TILE = 1 << 18
"""Numbers of a tile on the CPU."""


@dataclass(frozen=True)
class Merge:
    """All pairs of nodes that merge at one bit of the codes, P of them.

    left, right  [P] int64, row of the first leaf of either node
    a, b         [P, 1] float, sqrt(w / (w + v)) and sqrt(v / (w + v)) of their numbers of leaves w and v
    """

    left: Tensor
    right: Tensor
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
                Merge(m.left.to(device), m.right.to(device), m.a.to(device, dtype), m.b.to(device, dtype))
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
            raise ShapeError(
                f"the transform is over {self.size} voxels, got {list(rows.shape)}",
                actual=rows.shape,
                expected=(self.size, "C"),
            )
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
    return [
        Merge(
            torch.from_numpy(left[part]), torch.from_numpy(row[part]),
            torch.from_numpy(a[part, None]), torch.from_numpy(b[part, None]),
        )
        for part in np.split(order, borders)
    ]  # fmt: skip


class _Raht(torch.autograd.Function):
    """The transform is orthonormal: the gradient of one direction is the other one."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, plan: RahtPlan, back: bool) -> Tensor:
        ctx.plan, ctx.back = plan, back
        return _transformed(rows, plan, back)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return _transformed(grad, ctx.plan, not ctx.back), None, None


def _transformed(rows: Tensor, plan: RahtPlan, back: bool) -> Tensor:
    found = rows.detach().clone(memory_format=torch.contiguous_format)
    merges = plan.merges(found.device, found.dtype)
    most = max((len(merge.left) for merge in merges), default=0)
    if found.device.type == "cpu":
        # Tiles that a cache holds, in buffers made once: 2.8 times as fast as whole levels (benchmarks/raht.py)
        most = min(most, max(TILE // max(found.shape[1], 1), 1))
    buffers = found.new_empty(4, most, found.shape[1])
    for merge in reversed(merges) if back else merges:
        for start in range(0, len(merge.left), most):
            _butterfly(found, merge, slice(start, start + most), buffers, back)
    return found


def _butterfly(found: Tensor, merge: Merge, part: slice, buffers: Tensor, back: bool) -> None:
    """Replace the rows of some pairs by low and high, or `back`. No product is fused with a sum: all machines agree."""
    left, right, a, b = merge.left[part], merge.right[part], merge.a[part], merge.b[part]
    c, d, first, product = buffers[:, : len(left)]
    torch.index_select(found, 0, left, out=c)
    torch.index_select(found, 0, right, out=d)
    torch.mul(c, a, out=first)
    torch.mul(d, b, out=product)
    if back:
        first.sub_(product)
        second = c.mul_(b).add_(d.mul_(a))
    else:
        first.add_(product)
        second = d.mul_(a).sub_(c.mul_(b))
    found.index_copy_(0, left, first)
    found.index_copy_(0, right, second)
