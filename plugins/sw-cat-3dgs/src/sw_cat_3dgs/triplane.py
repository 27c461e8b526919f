"""Triplane: features of a place from three learned planes at several scales.

Trained in floats (bilinear, gradients to the planes); the file holds integers, from which both sides compute the same
features in integers: bilinear weights of 12 bits an axis. Source: CAT-3DGS (arXiv 2503.00357); exact form: the exact
mode of the codec library, rules 1 and 2.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

from sw_cat_3dgs.principal_frame import UNIT
from sw_codecs.exact_native import EXACT
from sw_codecs.fast import exact_operations
from sw_codecs.quantizers.straight_through import straight_through

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Axes (width, height) of the three planes."""
GAIN = 16
"""Integers of the file are round(GAIN * value)."""
INTEGER_LIMIT = 1 << 24
MOST_SCALES = 4
"""That the kernel of the exact look-up takes."""


class Triplane(nn.Module):
    """Planes [3, C, m B, m B] for each multiple m of the base resolution B; rows are the pair's second axis.

    Of scale s the sample p_s [3 C] joins the three planes. The feature is [p_1, p_1 + p_2, p_1 + p_2 + p_3, ...]:
    cumulative, so that fine planes add to coarse ones. Places outside the planes take the value on the border.

    A model that makes its planes while it trains starts with resolution 0 and replaces `planes.0`, `planes.1`, ... by
    what `initial` draws.
    """

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
        """Features [n, width] at places int64 [n,3] in 0 .. UNIT (`PrincipalFrame.unit`).

        rounded     planes as the file will have them; the gradient passes straight through the rounding
        """
        at = places.to(self.planes[0]) * (2 / UNIT) - 1  # [n, 3] in -1 .. 1
        pairs = torch.stack([at[:, pair] for pair in PAIRS])[:, None]  # [3, 1, n, 2]
        features: list[Tensor] = []
        for plane in self.planes:
            values = straight_through(plane, torch.round(plane * GAIN) / GAIN) if rounded else plane
            sample = grid_sample(values, pairs, padding_mode="border", align_corners=True)  # [3, C, 1, n]
            found = sample.flatten(0, 2).T  # [n, 3 C]
            features.append(features[-1] + found if features else found)
        return torch.cat(features, dim=1)

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
    def exact_lookup(integers: Sequence[Tensor]) -> Callable[[Tensor], Tensor]:
        """Features int64 [n, width] with 12 fractional bits, from `integers`, as a function of places.

        To be called often, with few places at once. The result does not depend on device or batch: integers alone.
        Values stay below 2^24.
        """
        corners = [plane.flatten(2).transpose(1, 2).contiguous() for plane in integers]  # [3, R*R, C]
        if _kernel_takes(corners) and EXACT.try_load():
            small = [each.to(torch.int32) for each in corners]
            sizes = [plane.shape[-1] for plane in integers]
            return lambda places: exact_operations.triplane_features(places.contiguous(), small, sizes)
        return lambda places: _exact_rows(integers, corners, places)


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
