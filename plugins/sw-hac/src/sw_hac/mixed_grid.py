"""Context model `hash-grid`: binary grids over space and over its three planes side by side, the context of HAC.

Each entry of a table is F signs. A position takes the signs at the corners of its cell on every level, weighted
(`sw_codecs.context.hash_grid`, which has one grid). Source: HAC (arXiv 2403.14530), section 4.1.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from sw_codecs.context.fast import integer_grid
from sw_codecs.context.hash_grid import HashGrid, table_size
from sw_codecs.entropy.rates import mask_bits
from sw_hac.fast import sign_lookup

Axes = tuple[int, ...]
Part = tuple[Axes, HashGrid]
"""Columns of a position that are the axes of a grid, and the grid."""


class MixedHashGrid(nn.Module):
    """Binary grids over (x,y,z), (x,y), (x,z) and (y,z), outputs in this order: the context of HAC.

    space, planes   resolutions of the levels over space, and over each plane: vertices per axis
    features        signs per entry
    log2_space, log2_planes     a level over space or a plane has at most 2^this entries
    generator       draws the learned numbers whose signs are taken; None: zeros, for a grid that is read from a file
    """

    AXES: ClassVar[tuple[Axes, ...]] = ((0, 1, 2), (0, 1), (0, 2), (1, 2))

    def __init__(
        self,
        space: Sequence[int] = (18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514),
        planes: Sequence[int] = (130, 258, 514, 1026),
        *,
        features: int = 4,
        log2_space: int = 13,
        log2_planes: int = 15,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.grids = nn.ModuleList(
            HashGrid.binary_grid(
                len(axes),
                space if len(axes) == 3 else planes,
                features=features,
                log2_size=log2_space if len(axes) == 3 else log2_planes,
                generator=generator,
            )
            for axes in self.AXES
        )

    @staticmethod
    def count(space: Sequence[int], planes: Sequence[int], *, features: int, log2_space: int, log2_planes: int) -> int:
        """Return the `entries` of such a grid before anything is allocated; arguments as of the constructor."""
        sizes = [table_size(r, 3, log2_space) for r in space] + 3 * [table_size(r, 2, log2_planes) for r in planes]
        return features * sum(sizes)

    @property
    def width(self) -> int:
        """Number of outputs."""
        return sum(grid.width for grid in self._all())

    @property
    def entries(self) -> int:
        """Number of signs."""
        return sum(grid.table.numel() for grid in self._all())

    @property
    def parts(self) -> list[Part]:
        """The grids, each with the axes that it lies over."""
        return [(axes, grid) for axes, grid in zip(self.AXES, self._all(), strict=True)]

    def forward(self, x: Tensor) -> Tensor:
        """Return features [n, width] in -1..1 of places [n,3] in 0..1."""
        return self.with_bits(x)[0]

    def with_bits(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the features, and the bits that all signs take in the file: a differentiable scalar.

        The bits are those of signs under their own share of ones, plus 32 for that share. Not differentiable for x.
        """
        look_up = sign_lookup.with_bits if sign_lookup.fits(self.parts, x) else with_bits
        return look_up(self.parts, x)

    @property
    def corners(self) -> int:
        """Number of corners that one place looks up: 8 per level over space, 4 per level over a plane."""
        return sum(len(grid.levels) << grid.dimensions for grid in self._all())

    def integer_features(self, codes: Tensor, dtype: torch.dtype = torch.int64) -> Tensor:
        """Return features [n, width] of 16-bit codes [n,3], integers alone, with 12 fractional bits: -4096..4096."""
        if integer_grid.fits(codes, self._all()[0].features):
            return integer_grid.integer_features(self.parts, codes, dtype)
        return torch.cat([grid.integer_features(codes[:, list(axes)]) for axes, grid in self.parts], dim=1).to(dtype)

    def signs(self) -> Tensor:
        """Return [entries] int64 of 0 and 1, grid by grid, level by level, entry by entry, as in the file."""
        return torch.cat([(grid.table.detach() >= 0).reshape(-1) for grid in self._all()]).to(torch.int64)

    @torch.no_grad()
    def load_signs(self, signs: Any) -> None:
        """Inverse of `signs`. Raises ValueError for another number of them."""
        values = torch.as_tensor(signs).reshape(-1)
        if len(values) != self.entries:
            raise ValueError(f"{len(values):,} signs for {self.entries:,} entries")
        start = 0
        for grid in self._all():
            part = values[start : start + grid.table.numel()]
            grid.table.copy_(part.view_as(grid.table).to(grid.table) * 2 - 1)
            start += grid.table.numel()

    def _all(self) -> list[HashGrid]:
        return [grid for grid in self.grids if isinstance(grid, HashGrid)]


def with_bits(parts: Sequence[Part], x: Tensor) -> tuple[Tensor, Tensor]:
    """Return features [n, width] of places [n,3] in grids side by side, and the bits of all signs; differentiable."""
    signs = [grid.values() for _, grid in parts]
    found = [grid(x[:, list(axes)], values) for (axes, grid), values in zip(parts, signs, strict=True)]
    return torch.cat(found, dim=1), mask_bits((torch.cat([each.flatten() for each in signs]) + 1) / 2)
