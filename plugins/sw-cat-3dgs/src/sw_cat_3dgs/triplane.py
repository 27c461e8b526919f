"""Context model `triplane`: features of a place from three learned planes at several scales.

Trained in floats (bilinear, gradients to the planes); the file holds integers, from which both sides compute the same
features in integers: bilinear weights of 12 bits an axis. Source: CAT-3DGS (arXiv 2503.00357); exact form: the exact
mode of the codec library, rules 1 and 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from sw_codecs.context.plane_kernels import fit_kernels, look_up, look_up_backward
from sw_codecs.context.principal_frame import UNIT, PrincipalFrame
from sw_codecs.exact_native import EXACT
from sw_codecs.native import CODECS

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Axes (width, height) of the three planes."""
GAIN = 16
"""Integers of the file are round(GAIN * value)."""
INTEGER_LIMIT = 1 << 24
ROWS_AT_ONCE = 1 << 13
MOST_SCALES = 4
"""That the kernel of the exact look-up takes."""
MOST_SAMPLED = 8
"""Scales that the kernel of training takes."""


class PlaneSites(NamedTuple):
    """Cells and weights of n places on the planes of each scale; training changes none while resolutions stay.

    cells       [n, scales, 3, 4] int32: the four values around a place, in a table of the 3 H W places of a scale
    weights     [n, scales, 3, 4]
    """

    cells: Tensor
    weights: Tensor

    def rows(self, rows: Tensor) -> PlaneSites:
        """Those of some of the places."""
        return PlaneSites(self.cells.index_select(0, rows), self.weights.index_select(0, rows))


class Triplane(nn.Module):
    """Planes [3, C, m B, m B] for each multiple m of the base resolution B; rows are the pair's second axis.

    Of scale s the sample p_s [3 C] joins the three planes. The feature is [p_1, p_1 + p_2, p_1 + p_2 + p_3, ...]:
    cumulative, so that fine planes add to coarse ones. Places outside the planes take the value on the border.

    A model that makes its planes while it trains starts with resolution 0 and replaces `planes.0`, `planes.1`, ... by
    what `initial` draws.
    """

    Frame: ClassVar[type[PrincipalFrame]] = PrincipalFrame

    def __init__(
        self,
        resolution: int = 0,
        channels: int = 72,
        multiples: Sequence[int] = (1, 2),
        *,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.channels, self.multiples = channels, tuple(multiples)
        self.planes = nn.ParameterList(self.initial(resolution, generator))

    def initial(self, resolution: int, generator: torch.Generator | None) -> list[Tensor]:
        """Fresh planes, uniform within 0.01 of zero; drawn on the CPU."""
        shapes = [(3, self.channels, m * resolution, m * resolution) for m in self.multiples]
        return [torch.rand(shape, generator=generator) * 0.02 - 0.01 for shape in shapes]

    @property
    def width(self) -> int:
        """Length of a feature."""
        return 3 * self.channels * len(self.multiples)

    def forward(self, places: Tensor, *, rounded: bool = True) -> Tensor:
        """Features [n, width] at places int64 [n,3] in 0 .. UNIT (`Frame.unit`).

        rounded     planes as the file will have them; the gradient passes straight through the rounding
        """
        return self.at_sites(self.sites(places), rounded=rounded)

    @torch.no_grad()
    def sites(self, places: Tensor) -> PlaneSites:
        """Cells and weights of `places` on the planes."""
        cells, weights = [], []
        for plane in self.planes:
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
        shape = (len(places), len(self.planes), len(PAIRS), 4)
        return PlaneSites(torch.stack(cells, dim=1).view(shape), torch.stack(weights, dim=1).view(shape))

    def at_sites(self, sites: PlaneSites, *, rounded: bool = True) -> Tensor:
        """`forward` of the places that `sites` was made from."""
        found: Tensor = _Sampled.apply(*sites, rounded, *self.planes)  # type: ignore[no-untyped-call]
        return found

    def integers(self) -> list[Tensor]:
        """Planes of the file, int64 [3, C, m B, m B] per scale. Raises ValueError if a value is not finite."""
        found = []
        for plane in self.planes:
            scaled = torch.round(plane.detach().to(torch.float64) * GAIN)
            if not bool((scaled.abs() < INTEGER_LIMIT).all()):
                raise ValueError("a value of the triplane is not finite or far too large")
            found.append(scaled.to(torch.int64))
        return found

    @staticmethod
    def exact(integers: Sequence[Tensor], places: Tensor) -> Tensor:
        """Features int64 [n, width] with 12 fractional bits, from `integers` and places as above.

        The result does not depend on device or batch: integers alone. Values stay below 2^24.
        """
        lookup = Triplane.exact_lookup(integers)
        return torch.cat([lookup(block) for block in places.split(ROWS_AT_ONCE)])

    @staticmethod
    def exact_lookup(integers: Sequence[Tensor]) -> Callable[[Tensor], Tensor]:
        """`exact` of one set of planes, as a function of places: to be called often, with few places at once."""
        corners = [plane.flatten(2).transpose(1, 2).contiguous() for plane in integers]  # [3, R*R, C]
        if _kernel_takes(corners) and EXACT.try_load():
            small = [each.to(torch.int32) for each in corners]
            sizes = [plane.shape[-1] for plane in integers]
            return lambda places: torch.ops.sw_codecs_exact.triplane_features(places.contiguous(), small, sizes)
        return lambda places: _exact_rows(integers, corners, places)


class _Sampled(torch.autograd.Function):
    """Features [n, width] of planes at PlaneSites.

    As tables of all channels of a place: four rows are read where `grid_sample` reads each channel in another part of
    memory, and on the way back rows are added, where it would also find the derivative by the sites.
    """

    @staticmethod
    def forward(ctx: Any, cells: Tensor, weights: Tensor, rounded: bool, *planes: Tensor) -> Tensor:
        n, channels = len(cells), planes[0].shape[1]
        ctx.save_for_backward(cells, weights)
        ctx.shapes = [plane.shape for plane in planes]
        ctx.on_gpu = fit_kernels(planes)
        if ctx.on_gpu:
            ctx.planes = [plane.detach() for plane in planes]
            return look_up(cells, weights, planes, GAIN if rounded else 0)
        tables = [plane.movedim(1, 3).reshape(-1, channels) for plane in planes]  # [3 H W, C]
        if rounded:
            tables = [torch.round(table * GAIN).div_(GAIN) for table in tables]
        ctx.by_kernel = _sites_fit_kernel(weights, tables)
        if ctx.by_kernel:
            tables = [table.contiguous() for table in tables]
            return torch.ops.sw_codecs.sites_lookup(cells.contiguous(), weights.contiguous(), tables)
        width = len(PAIRS) * channels
        features = weights.new_empty(n, len(planes), width)
        for i, table in enumerate(tables):
            index, share = cells[:, i].reshape(-1, 4), weights[:, i].reshape(-1, 4)
            found = nn.functional.embedding_bag(index, table, per_sample_weights=share, mode="sum").view(n, width)
            if i == 0:
                features[:, i] = found
            else:
                torch.add(found, features[:, i - 1], out=features[:, i])
        return features.flatten(1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        cells, weights = ctx.saved_tensors
        if ctx.on_gpu:
            return None, None, None, *look_up_backward(cells, weights, grad, ctx.planes)
        if ctx.by_kernel:
            rows_of = [k * h * w for k, _, h, w in ctx.shapes]
            tables = torch.ops.sw_codecs.sites_backward(
                cells.contiguous(), weights.contiguous(), grad.contiguous(), rows_of, ctx.shapes[0][1]
            )
            return None, None, None, *map(_as_plane, tables, ctx.shapes)
        parts = grad.unflatten(1, (len(ctx.shapes), len(PAIRS), -1))  # [n, scales, 3, C]
        total: Tensor | None = None
        found: list[Tensor] = []
        for i in reversed(range(len(ctx.shapes))):
            part = parts[:, i]
            total = part if total is None else total + part  # a plane is in its own feature and all finer ones
            k, channels, h, w = ctx.shapes[i]
            table = grad.new_zeros(k * h * w, channels)
            rows = total.reshape(-1, channels)
            weighted = torch.empty_like(rows)  # one for all: fresh memory costs a CPU more than the arithmetic
            for index, share in zip(cells[:, i].unbind(2), weights[:, i].unbind(2), strict=True):
                torch.mul(rows, share.reshape(-1, 1), out=weighted)
                table.index_add_(0, index.reshape(-1), weighted)
            found.append(_as_plane(table, ctx.shapes[i]))
        return None, None, None, *reversed(found)


def _as_plane(table: Tensor, shape: Sequence[int]) -> Tensor:
    """A plane [3, C, H, W] of `shape` from its table [3 H W, C]."""
    k, channels, h, w = shape
    return table.view(k, h, w, channels).movedim(3, 1).contiguous()


def _sites_fit_kernel(weights: Tensor, tables: Sequence[Tensor]) -> bool:
    """Whether there is a kernel for the samples of float32 planes on this device; loads it."""
    if len(tables) > MOST_SAMPLED or not tables[0].numel():
        return False
    fits = all(t.dtype == torch.float32 and t.device.type == "cpu" for t in (weights, *tables))
    return fits and CODECS.try_load()


def _kernel_takes(corners: Sequence[Tensor]) -> bool:
    return 0 < len(corners) <= MOST_SCALES and all(c.device.type == "cpu" and c.shape[1] for c in corners)


def _exact_rows(integers: Sequence[Tensor], corners: Sequence[Tensor], places: Tensor) -> Tensor:
    total, found = None, []
    for plane, values in zip(integers, corners, strict=True):
        size = plane.shape[-1]
        at = (places * (size - 1)) >> 8  # 12 fractional bits
        cell = torch.clamp(at >> 12, max=max(size - 2, 0))
        part = at - (cell << 12)  # 0 .. 4096
        following = torch.clamp(cell + 1, max=size - 1)
        samples = []
        for (a, b), table in zip(PAIRS, values, strict=True):
            x, y = part[:, a, None], part[:, b, None]
            left, right, upper, lower = cell[:, a], following[:, a], cell[:, b] * size, following[:, b] * size
            samples.append(
                (4096 - y) * ((4096 - x) * table[upper + left] + x * table[upper + right])
                + y * ((4096 - x) * table[lower + left] + x * table[lower + right])
            )
        sample = torch.cat(samples, dim=1)  # [n, 3 C], 24 fractional bits of GAIN * value
        total = sample if total is None else total + sample
        found.append(total >> 16)
    return torch.cat(found, dim=1)
