"""Context model `hash-grid`: multi-resolution grids of learned features, looked up by position.

Two kinds. `HashGrid.binary`: signs of learned numbers, as in HAC (arXiv 2403.14530): vertices on the border do not
take part, the other weights are brought to sum 1, and outside [0,1] all features are 0. `HashGrid.real`: the learned
numbers themselves, as in instant-ngp (arXiv 2201.05989). A level whose vertices all fit its table is dense, any other
is hashed. `MixedHashGrid` puts a binary grid over space and three over its planes side by side.

For files the lookup of 16-bit position codes is done in integers alone (`integer_features`), so that every machine
has the same features. Source: specification of the codec library, context models, and exact mode, rule 2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sw_codecs.rates import mask_bits
from sw_codecs.rounding import SteBinary

PRIMES = (1, 2654435761, 805459861)
INITIAL = 1e-4
FRACTION = 12
POSITION_TOP = 65535
INTEGER_ROWS = 1 << 14
"""Rows of `integer_features` that are looked up together."""


@dataclass(frozen=True)
class Level:
    """One resolution.

    scale       position in cells is x * scale + 0.5
    resolution  vertices an axis, R
    size        entries of its table, first of them number `start`
    dense       the table has an entry for every vertex
    """

    scale: float
    resolution: int
    size: int
    start: int
    dense: bool


class HashGrid(nn.Module):
    """[n, d] in [0,1] -> [n, levels * features]; d is 2 or 3.

    table   [entries, features] parameter: learned numbers of all levels, level by level
    """

    def __init__(
        self,
        dimensions: int,
        levels: Sequence[tuple[float, int]],
        *,
        features: int,
        log2_size: int,
        binary: bool,
        generator: torch.Generator,
    ) -> None:
        """levels: (scale, resolution) of each. Raises ValueError if a level is out of range.

        binary      signs, without border vertices; else the numbers with all vertices
        """
        super().__init__()
        if dimensions not in (2, 3) or not levels or features < 1 or not 1 <= log2_size <= 30:
            raise ValueError("a hash grid has 2 or 3 axes, at least one level and feature, and tables of 2^1..2^30")
        self.dimensions, self.features, self.binary = dimensions, features, binary
        self.levels: list[Level] = []
        start = 0
        for scale, resolution in levels:
            if not 2 <= resolution <= 1 << 16 or not 0 < scale <= resolution:
                raise ValueError(f"a level of {resolution} vertices and scale {scale} is out of range")
            vertices = resolution**dimensions
            size = -(-min(1 << log2_size, vertices) // 8) * 8
            self.levels.append(Level(scale, resolution, size, start, vertices <= size))
            start += size
        self.table = nn.Parameter((torch.rand(start, features, generator=generator) * 2 - 1) * INITIAL)
        for name, values in (
            ("scale", [level.scale for level in self.levels]),
            ("resolution", [level.resolution for level in self.levels]),
            ("size", [level.size for level in self.levels]),
            ("start", [level.start for level in self.levels]),
            ("dense", [level.dense for level in self.levels]),
            ("corners", [[(c >> axis) & 1 for axis in range(dimensions)] for c in range(1 << dimensions)]),
        ):
            dtype = {"scale": torch.float64, "dense": torch.bool}.get(name, torch.int64)
            self.register_buffer(f"_{name}", torch.tensor(values, dtype=dtype), persistent=False)

    @classmethod
    def binary_grid(
        cls, dimensions: int, resolutions: Sequence[int], *, features: int, log2_size: int, generator: torch.Generator
    ) -> HashGrid:
        """As in HAC: resolutions R >= 3 count the border, R - 2 vertices an axis are used."""
        if min(resolutions, default=0) < 3:
            raise ValueError(f"resolutions {list(resolutions)} must be 3 or more: two vertices an axis are border")
        levels = [(float(r - 2), int(r)) for r in resolutions]
        return cls(dimensions, levels, features=features, log2_size=log2_size, binary=True, generator=generator)

    @classmethod
    def real_grid(
        cls,
        dimensions: int = 3,
        *,
        levels: int = 16,
        features: int = 2,
        log2_size: int = 19,
        coarsest: int = 16,
        finest: int = 2048,
        generator: torch.Generator,
    ) -> HashGrid:
        """As in instant-ngp: resolutions from `coarsest` to `finest` in equal ratios."""
        scales = [coarsest * (finest / coarsest) ** (i / max(levels - 1, 1)) - 1 for i in range(levels)]
        found = [(scale, math.ceil(scale - 1e-9) + 1) for scale in scales]  # 39.0000000001 is 39
        return cls(dimensions, found, features=features, log2_size=log2_size, binary=False, generator=generator)

    @property
    def width(self) -> int:
        """Number of outputs."""
        return len(self.levels) * self.features

    def values(self) -> Tensor:
        """[entries, features] what is looked up; signs have a straight-through gradient."""
        return SteBinary()(self.table) if self.binary else self.table

    def forward(self, x: Tensor, values: Tensor | None = None) -> Tensor:
        """[n, width]. Differentiable for the table and for x.

        values  `self.values()`, if the caller has them already
        """
        values = self.values() if values is None else values
        n, levels, corners = len(x), len(self.levels), len(self._corners)
        if n == 0:
            return values.new_zeros(0, self.width)
        inside = ((x >= 0) & (x <= 1)).all(dim=1)
        place = x.clamp(0, 1)[:, None] * self._scale.to(x.dtype)[:, None] + 0.5  # [n,L,d]
        cell = torch.floor(place.detach())
        part = place - cell
        vertices = cell.to(torch.int64)[:, :, None] + self._corners  # [n,L,2^d,d]
        factors = torch.where(self._corners > 0, part[:, :, None], 1 - part[:, :, None])
        weights = _product(factors)
        if self.binary:
            weights = weights * self._not_border(vertices)
            total = weights.sum(dim=2, keepdim=True)
            weights = weights / torch.where(total > 0, total, torch.ones_like(total))
            weights = weights * inside[:, None, None]
        index = self._entries(vertices)
        found = F.embedding_bag(
            index.view(n * levels, corners),
            values,
            per_sample_weights=weights.reshape(n * levels, corners).to(values.dtype),
            mode="sum",
        )
        return found.view(n, self.width)

    def integer_features(self, codes: Tensor) -> Tensor:
        """[n, width] int64 with 12 fractional bits, of 16-bit codes [n,d] (x = code / 65535); integers alone.

        Raises ValueError for a grid that is not binary.
        """
        if not self.binary:
            raise ValueError("only a binary hash grid is looked up in integers")
        if codes.shape[1:] != (self.dimensions,) or codes.is_floating_point():
            raise ValueError(f"position codes must be integers [n, {self.dimensions}], not {list(codes.shape)}")
        signs = torch.where(self.table.detach() >= 0, 1, -1).to(torch.int64)
        blocks = [self._integer_block(block, signs) for block in codes.to(torch.int64).split(INTEGER_ROWS)]
        return torch.cat(blocks) if blocks else codes.new_zeros(0, self.width, dtype=torch.int64)

    def _integer_block(self, codes: Tensor, signs: Tensor) -> Tensor:
        n = len(codes)
        inside = ((codes >= 0) & (codes <= POSITION_TOP)).all(dim=1)
        cells = (self._resolution - 2)[:, None]
        at = codes.clamp(0, POSITION_TOP)[:, None] * cells << FRACTION  # below 2^44
        place = torch.div(at, POSITION_TOP, rounding_mode="floor") + (1 << (FRACTION - 1))  # [n,L,d]
        cell, part = place >> FRACTION, place & ((1 << FRACTION) - 1)
        vertices = cell[:, :, None] + self._corners
        factors = torch.where(self._corners > 0, part[:, :, None], (1 << FRACTION) - part[:, :, None])
        weights = _product(factors) * self._not_border(vertices)  # [n,L,2^d], below 2^37
        total = weights.sum(dim=2)
        found = (signs[self._entries(vertices)] * weights[..., None]).sum(dim=2)  # [n,L,F]
        found = torch.div(found << FRACTION, total.clamp(min=1)[..., None], rounding_mode="floor")
        return (found * inside[:, None, None]).reshape(n, self.width)

    def _not_border(self, vertices: Tensor) -> Tensor:
        """[n,L,2^d] bool."""
        last = (self._resolution - 1)[:, None, None]
        return ((vertices > 0) & (vertices < last)).all(dim=3)

    def _entries(self, vertices: Tensor) -> Tensor:
        """[n,L,2^d] int64: entries of the table for vertices [n,L,2^d,d]; beyond the last vertex counts as it."""
        last = (self._resolution - 1)[:, None, None]
        p = torch.minimum(vertices.clamp(min=0), last)
        resolution, size = self._resolution[:, None], self._size[:, None]
        straight, hashed = p[..., 0], p[..., 0]
        stride = resolution
        for axis in range(1, self.dimensions):
            straight = straight + p[..., axis] * stride
            stride = stride * resolution
            hashed = hashed ^ (p[..., axis] * PRIMES[axis] & 0xFFFFFFFF)
        return torch.where(self._dense[:, None], straight, hashed % size) + self._start[:, None]

    def extra_repr(self) -> str:
        kind = "binary" if self.binary else "real"
        return f"{kind}, {self.dimensions} axes, resolutions {[level.resolution for level in self.levels]}"


class MixedHashGrid(nn.Module):
    """Binary grids over (x,y,z), (x,y), (x,z) and (y,z), outputs in this order: the context of HAC.

    space, planes   resolutions of the levels over space, and over each plane
    features        numbers an entry has
    log2_space, log2_planes     logarithms of the largest table of a level
    """

    AXES = ((0, 1, 2), (0, 1), (0, 2), (1, 2))
    Grid = HashGrid

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
        generator = torch.Generator() if generator is None else generator
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

    @property
    def width(self) -> int:
        """Number of outputs."""
        return sum(grid.width for grid in self._all())

    @property
    def entries(self) -> int:
        """Number of signs."""
        return sum(grid.table.numel() for grid in self._all())

    def forward(self, x: Tensor) -> Tensor:
        """[n,3] in [0,1] -> [n, width]."""
        return self.with_bits(x)[0]

    def with_bits(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The features, and the bits of all signs under their own share of ones (+ 32), a differentiable scalar."""
        values = [grid.values() for grid in self._all()]
        found = [
            grid(x[:, list(axes)], signs) for grid, axes, signs in zip(self._all(), self.AXES, values, strict=True)
        ]
        ones = torch.cat([(signs.reshape(-1) + 1) / 2 for signs in values])
        return torch.cat(found, dim=1), mask_bits(ones)

    def integer_features(self, codes: Tensor) -> Tensor:
        """[n,3] 16-bit codes -> [n, width] int64 with 12 fractional bits."""
        return torch.cat(
            [grid.integer_features(codes[:, list(axes)]) for grid, axes in zip(self._all(), self.AXES, strict=True)],
            dim=1,
        )

    def signs(self) -> Tensor:
        """[entries] int64 of 0 and 1, grid by grid, level by level, entry by entry: what the file holds."""
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


def _product(factors: Tensor) -> Tensor:
    """Product over the last axis, factor by factor: its gradient needs no division."""
    found = factors[..., 0]
    for axis in range(1, factors.shape[-1]):
        found = found * factors[..., axis]
    return found
