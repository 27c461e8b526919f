"""Features of a triplane by kernels, on CPU and CUDA, at places whose cells are worked out once for all steps.

Plain form: a call of `triplane.Triplane`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled
from sw_cat_3dgs.fast.plane_kernels import fit_kernels, sampled, sampled_backward
from sw_cat_3dgs.principal_frame import UNIT
from sw_cat_3dgs.triplane import GAIN, PAIRS, Triplane
from sw_codecs.fast import kernel_operations
from sw_codecs.native import CODECS

MOST_SCALES = 8
"""Scales that the kernel on the CPU takes."""


class PlaneSites(NamedTuple):
    """Cells and weights of n places on the planes of each scale; training changes none while resolutions stay.

    cells       [n, scales, 3, 4] int32: the four values around a place, in a table of the 3 H W places of a scale
    weights     [n, scales, 3, 4]
    """

    cells: Tensor
    weights: Tensor

    def rows(self, rows: Tensor) -> PlaneSites:
        """Return the cells and weights of the places `rows` [S] int64."""
        return PlaneSites(self.cells.index_select(0, rows), self.weights.index_select(0, rows))


@torch.no_grad()
def sites_of(planes: Sequence[Tensor], places: Tensor) -> PlaneSites:
    """Cells and weights of places int64 [n, 3] in 0 .. UNIT on planes [3, C, R, R]."""
    cells, weights = [], []
    for plane in planes:
        size = plane.shape[-1]
        at = places.to(plane) * ((size - 1) / UNIT)  # [n,3]
        cell = at.floor().clamp_(0, max(size - 2, 0))
        far, last = at - cell, size - 1
        lower, upper = cell.int(), (cell.int() + 1).clamp_(max=last)
        for i, (a, b) in enumerate(PAIRS):
            columns = torch.stack([lower[:, a], upper[:, a]], dim=1)
            rows = torch.stack([lower[:, b], upper[:, b]], dim=1) * size + i * size * size
            cells.append((rows[:, :, None] + columns[:, None]).flatten(1))
            shares = (torch.stack([1 - far[:, axis], far[:, axis]], dim=1) for axis in (b, a))
            weights.append((next(shares)[:, :, None] * next(shares)[:, None]).flatten(1))
    shape = (len(places), len(planes), len(PAIRS), 4)
    return PlaneSites(torch.stack(cells, dim=1).view(shape), torch.stack(weights, dim=1).view(shape))


def fits(triplane: Triplane) -> bool:
    """Whether there are kernels for its planes; loads them."""
    planes = list(triplane.planes)
    if not fast_enabled():
        return False
    if all(plane.device.type == "cpu" and plane.dtype == torch.float32 for plane in planes):
        return 0 < len(planes) <= MOST_SCALES and planes[0].numel() > 0 and CODECS.try_load()
    return fit_kernels(planes)


def kept_sites(triplane: Triplane, places: Tensor) -> PlaneSites:
    """`sites_of` the places, worked out anew when these are another tensor or the planes have another resolution."""
    size, kept = triplane.planes[0].shape[-1], KEPT.get(triplane)
    if kept is None or kept[0] is not places or kept[1] != size:
        KEPT.pop(triplane, None)  # the old ones go before the new ones come
        KEPT[triplane] = kept = places, size, sites_of(list(triplane.planes), places)
    return kept[2]


def sample(planes: Sequence[Tensor], sites: PlaneSites, *, rounded: bool) -> Tensor:
    """Features [n, width] of planes at `sites` of the same, if they fit; differentiable by the planes."""
    found: Tensor = _Sampled.apply(*sites, rounded, *planes)  # type: ignore[no-untyped-call]
    return found


def look_up(triplane: Triplane, places: Tensor, *, rounded: bool) -> Tensor:
    """As a call of `triplane`."""
    planes = list(triplane.planes)
    return sample(planes, sites_of(planes, places), rounded=rounded)


class _Sampled(torch.autograd.Function):
    """Features [n, width] of planes at PlaneSites.

    As tables of all channels of a place: four rows are read where `grid_sample` reads each channel in another part of
    memory, and on the way back rows are added, where it would also find the derivative by the sites.
    """

    @staticmethod
    def forward(ctx: Any, cells: Tensor, weights: Tensor, rounded: bool, *planes: Tensor) -> Tensor:
        cells, weights = cells.contiguous(), weights.contiguous()
        ctx.save_for_backward(cells, weights)
        ctx.shapes = [plane.shape for plane in planes]
        ctx.on_gpu = planes[0].is_cuda
        if ctx.on_gpu:
            ctx.planes = [plane.detach() for plane in planes]
            return sampled(cells, weights, planes, GAIN if rounded else 0)
        tables = [plane.movedim(1, 3).reshape(-1, plane.shape[1]) for plane in planes]  # [3 H W, C]
        if rounded:
            tables = [torch.round(table * GAIN).div_(GAIN) for table in tables]
        found: Tensor = kernel_operations.sites_lookup(cells, weights, [table.contiguous() for table in tables])
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        cells, weights = ctx.saved_tensors
        if ctx.on_gpu:
            return None, None, None, *sampled_backward(cells, weights, grad, ctx.planes)
        rows = [k * h * w for k, _, h, w in ctx.shapes]
        tables = kernel_operations.sites_backward(cells, weights, grad.contiguous(), rows, ctx.shapes[0][1])
        return None, None, None, *map(_as_plane, tables, ctx.shapes)


def _as_plane(table: Tensor, shape: Sequence[int]) -> Tensor:
    """A plane [3, C, H, W] of `shape` from its table [3 H W, C]."""
    k, channels, h, w = shape
    return table.view(k, h, w, channels).movedim(3, 1).contiguous()


KEPT: WeakKeyDictionary[Triplane, tuple[Tensor, int, PlaneSites]] = WeakKeyDictionary()
"""Places of all anchors, the size of the coarsest planes, and the sites there."""
