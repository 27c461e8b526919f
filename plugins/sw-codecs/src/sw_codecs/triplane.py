"""Context model `triplane`: features of a place from three learned planes at several scales.

Trained in floats (bilinear, gradients to the planes); the file holds integers, from which both sides compute the same
features in integers: bilinear weights of 12 bits an axis. Source: CAT-3DGS (arXiv 2503.00357); exact form: the exact
mode of the codec library, rules 1 and 2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from sw_codecs.principal_frame import UNIT, PrincipalFrame

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Axes (width, height) of the three planes."""
GAIN = 16
"""Integers of the file are round(GAIN * value)."""
INTEGER_LIMIT = 1 << 24
ROWS_AT_ONCE = 1 << 13
_SAMPLING = (0, 1, True)  # bilinear, border, align_corners, as torch numbers them


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

    def sites(self, places: Tensor) -> Tensor:
        """Where `places` lie on the planes, [3,1,n,2] in -1..1: what no training changes."""
        at = places.to(self.planes[0]) * (2.0 / UNIT) - 1
        return torch.stack([at[:, pair] for pair in PAIRS])[:, None]

    def at_sites(self, sites: Tensor, *, rounded: bool = True) -> Tensor:
        """`forward` of the places that `sites` was made from."""
        found: Tensor = _Sampled.apply(sites, rounded, *self.planes)  # type: ignore[no-untyped-call]
        return found

    def integers(self) -> list[Tensor]:
        """What goes into the file: int64 [3, C, m B, m B] per scale. Raises ValueError if a value is not finite."""
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
        corners = [plane.flatten(2).transpose(1, 2).contiguous() for plane in integers]  # [3, R*R, C]
        found = [_exact_rows(integers, corners, block) for block in places.split(ROWS_AT_ONCE)]
        return torch.cat(found)


class _Sampled(torch.autograd.Function):
    """Features [n, width] of planes at sites; bilinear, border as padding, corners aligned."""

    @staticmethod
    def forward(ctx: Any, sites: Tensor, rounded: bool, *planes: Tensor) -> Tensor:
        values = [torch.round(plane * GAIN).div_(GAIN) for plane in planes] if rounded else list(planes)
        found: list[Tensor] = []
        for plane in values:
            sample = torch.grid_sampler_2d(plane, sites, *_SAMPLING)  # [3,C,1,n]
            found.append(sample.add_(found[-1]) if found else sample)
        ctx.save_for_backward(sites, *values)
        return torch.cat(found).flatten(0, 2).T

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        sites, *values = ctx.saved_tensors
        parts = grad.T.reshape(len(values), *values[0].shape[:2], 1, len(grad)).unbind(0)
        total: Tensor | None = None
        found: list[Tensor] = []
        for plane, part in zip(reversed(values), reversed(parts), strict=True):
            total = part if total is None else total + part  # a plane is in its own feature and all finer ones
            to_plane, _ = torch.ops.aten.grid_sampler_2d_backward(total, plane, sites, *_SAMPLING, [True, False])
            found.append(to_plane)
        return None, None, *reversed(found)


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
