"""Multi-resolution grids of learned features, looked up by position.

Two kinds. `HashGrid.binary`: signs of learned numbers, as in HAC (arXiv 2403.14530): vertices on the border do not
take part, the other weights are brought to sum 1, and outside [0,1] all features are 0. `HashGrid.real`: the learned
numbers themselves, as in instant-ngp (arXiv 2201.05989). A level whose vertices all fit its table is dense, any other
is hashed.

For files the lookup of 16-bit position codes is done in integers alone (`integer_features`), so that every machine
has the same features. Source: specification of the codec library, context models, and exact mode, rule 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from splatwizard_native import fast_enabled
from sw_codecs.context.fast import grid_lookup, integer_grid
from sw_codecs.quantizers.straight_through import signs

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


def corner_lookup(grid: HashGrid, x: Tensor, values: Tensor) -> Tensor:
    """Features [n, width] of places [n,d], from the corners of their cells; differentiable for values and x."""
    n, levels = len(x), len(grid.levels)
    index, weights = grid.corners_of(x)
    add_up = grid_lookup.weighted_rows if fast_enabled() else weighted_rows
    found = add_up(values, index.view(n * levels, -1), weights.to(values.dtype).view(n * levels, -1), levels)
    return grid.in_order(found.view(n, levels, grid.features))


def weighted_rows(values: Tensor, index: Tensor, weights: Tensor, levels: int) -> Tensor:
    """sum_c weights[b,c] values[index[b,c]]: [B,F] from values [E,F]; bag b belongs to level b % levels."""
    return F.embedding_bag(index, values, per_sample_weights=weights, mode="sum")


class HashGrid(nn.Module):
    """[n, d] in [0,1] -> [n, levels * features]; d is 2 or 3.

    table   [entries, features] parameter: learned numbers of all levels, level by level
    """

    _scale: Tensor
    _last: Tensor
    _start: Tensor
    _order: Tensor

    def __init__(
        self,
        dimensions: int,
        levels: Sequence[tuple[float, int]],
        *,
        features: int,
        log2_size: int,
        binary: bool,
        generator: torch.Generator | None,
    ) -> None:
        """levels: (scale, resolution) of each. Raises ValueError if a level is out of range.

        binary      signs, without border vertices; else the numbers with all vertices
        generator   draws the first values; None: zeros, for a grid that is read from a file
        """
        super().__init__()
        if dimensions not in (2, 3) or not levels or features < 1 or not 3 <= log2_size <= 30:
            raise ValueError("a hash grid has 2 or 3 axes, at least one level and feature, and tables of 2^3..2^30")
        self.dimensions, self.features, self.binary, self.log2_size = dimensions, features, binary, log2_size
        self.levels: list[Level] = []
        start = 0
        for scale, resolution in levels:
            if not 2 <= resolution <= 1 << 16 or not 0 < scale <= resolution:
                raise ValueError(f"a level of {resolution} vertices and scale {scale} is out of range")
            vertices = resolution**dimensions
            size = table_size(resolution, dimensions, log2_size)
            self.levels.append(Level(scale, resolution, size, start, vertices <= size))
            start += size
        self.table = nn.Parameter(torch.zeros(start, features))
        if generator is not None:
            with torch.no_grad():
                self.table.uniform_(-INITIAL, INITIAL, generator=generator)
        # Dense levels come first in the buffers below; `order` brings features back into the order of the levels.
        dense_first = sorted(range(len(self.levels)), key=lambda i: not self.levels[i].dense)
        chosen = [self.levels[i] for i in dense_first]
        self.dense_levels = sum(level.dense for level in chosen)
        self._in_order = dense_first == list(range(len(chosen)))
        order = sorted(range(len(chosen)), key=lambda i: dense_first[i])
        for name, values, dtype in (
            ("scale", [level.scale for level in chosen], torch.float64),
            ("last", [level.resolution - 1 for level in chosen], torch.int64),
            ("start", [level.start for level in chosen], torch.int32),
            ("order", order, torch.int64),
        ):
            self.register_buffer(f"_{name}", torch.tensor(values, dtype=dtype), persistent=False)

    @classmethod
    def binary_grid(
        cls,
        dimensions: int,
        resolutions: Sequence[int],
        *,
        features: int,
        log2_size: int,
        generator: torch.Generator | None,
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
        finest: float = 2048,
        generator: torch.Generator | None,
    ) -> HashGrid:
        """As in instant-ngp: resolutions from `coarsest` to `finest` in equal ratios; generator as above."""
        found = real_levels(levels, coarsest, finest)
        return cls(dimensions, found, features=features, log2_size=log2_size, binary=False, generator=generator)

    @property
    def width(self) -> int:
        """Number of outputs."""
        return len(self.levels) * self.features

    def values(self) -> Tensor:
        """[entries, features] what is looked up; signs have a straight-through gradient."""
        return signs(self.table) if self.binary else self.table

    def forward(self, x: Tensor, values: Tensor | None = None) -> Tensor:
        """[n, width]. Differentiable for the table and for x.

        values  `self.values()`, if the caller has them already
        """
        values = self.values() if values is None else values
        if len(x) == 0:
            return values.new_zeros(0, self.width)
        look_up = grid_lookup.lookup if grid_lookup.fits(self, x, values) else corner_lookup
        return look_up(self, x, values)

    def corners_of(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Entries of the table (int32) and their weights (dtype of x), both [n, levels, 2^d], the order of the buffers.

        Weights are differentiable for x.
        """
        inside = ((x >= 0) & (x <= 1)).all(dim=1, keepdim=True)
        lower, ends = [], []
        for coordinate in x.clamp(0, 1).unbind(1):
            place = coordinate[:, None] * self._scale.to(x.dtype) + 0.5  # [n,L]
            cell = torch.floor(place.detach())
            part = place - cell
            lower.append(cell.to(torch.int64))
            near, far = 1 - part, part
            if self.binary:
                # A corner counts if none of its coordinates is on the border, so weights can be set to 0, and brought
                # to sum 1, axis by axis.
                near, far = self._off_border(near, far, lower[-1])
                total = near + far
                total = torch.where(total > 0, total, torch.ones_like(total))
                near, far = near / total * inside, far / total * inside
            ends.append((near, far))
        return self._entries(lower), _corners(ends, torch.mul)

    def integer_features(self, codes: Tensor) -> Tensor:
        """[n, width] int64 with 12 fractional bits, of 16-bit codes [n,d] (x = code / 65535); integers alone.

        Raises ValueError for a grid that is not binary.
        """
        if not self.binary:
            raise ValueError("only a binary hash grid is looked up in integers")
        if codes.shape[1:] != (self.dimensions,) or codes.is_floating_point():
            raise ValueError(f"position codes must be integers [n, {self.dimensions}], not {list(codes.shape)}")
        if self.dimensions == 3 and integer_grid.fits(codes, self.features):
            return integer_grid.integer_features([((0, 1, 2), self)], codes, torch.int64)
        signs = torch.where(self.table.detach() >= 0, 1.0, -1.0).to(torch.float64)
        blocks = [self._integer_block(block, signs) for block in codes.to(torch.int64).split(INTEGER_ROWS)]
        return torch.cat(blocks) if blocks else codes.new_zeros(0, self.width, dtype=torch.int64)

    def integer_levels(self, column: int) -> Tensor:
        """[3, levels] last vertices, first entries and columns from `column` on, for a kernel: dense levels first."""
        order = torch.argsort(self._order)
        return torch.stack([self._last, self._start.to(torch.int64), column + order * self.features])

    def _integer_block(self, codes: Tensor, signs: Tensor) -> Tensor:
        inside = ((codes >= 0) & (codes <= POSITION_TOP)).all(dim=1)
        lower, ends = [], []
        for coordinate in codes.clamp(0, POSITION_TOP).unbind(1):
            at = coordinate[:, None] * (self._last - 1) << FRACTION  # below 2^44
            place = torch.div(at, POSITION_TOP, rounding_mode="floor") + (1 << (FRACTION - 1))  # [n,L]
            part = place & ((1 << FRACTION) - 1)
            lower.append(place >> FRACTION)
            ends.append(self._off_border((1 << FRACTION) - part, part, lower[-1]))
        weights = _corners(ends, torch.mul)  # [n,L,2^d]
        total = weights.sum(dim=2)  # at most 2^36
        # In float64, which is exact for sums of integers below 2^53, in whatever order.
        index = self._entries(lower).flatten(0, 1)
        sums = F.embedding_bag(index, signs, per_sample_weights=weights.flatten(0, 1).to(torch.float64), mode="sum")
        found = sums.to(torch.int64).view(*total.shape, self.features)
        found = torch.div(found << FRACTION, total.clamp(min=1)[..., None], rounding_mode="floor")
        return self.in_order(found * inside[:, None, None])

    def _off_border(self, near: Tensor, far: Tensor, lower: Tensor) -> tuple[Tensor, Tensor]:
        """Weights [n,L] of the two ends of an axis, 0 where the end is a border vertex."""
        return near * (lower > 0), far * (lower + 1 < self._last)

    def _entries(self, lower: Sequence[Tensor]) -> Tensor:
        """[n,L,2^d] int32: entries of the table for the corners of cells, [n,L] for each axis; beyond the last vertex
        counts as it."""
        dense, last = self.dense_levels, self._last
        straight, hashed = [], []
        # All hashed tables have one size, a power of two: the remainder is a mask, which may be taken early.
        mask = (1 << self.log2_size) - 1
        for axis, cell in enumerate(lower):
            ends = torch.minimum(cell, last), torch.minimum(cell + 1, last)
            stride = (last[:dense] + 1) ** axis
            straight.append(tuple((end[:, :dense] * stride).int() for end in ends))
            hashed.append(tuple((end[:, dense:] * PRIMES[axis] & mask).int() for end in ends))
        found = [_corners(straight, torch.add)] if dense else []
        if dense < len(last):
            found.append(_corners(hashed, torch.bitwise_xor))
        return torch.cat(found, dim=1).add_(self._start[:, None])

    def in_order(self, found: Tensor) -> Tensor:
        """[n, width] from [n,L,F] in the order of the buffers."""
        if not self._in_order:
            found = found[:, self._order]
        return found.reshape(len(found), self.width)

    def extra_repr(self) -> str:
        kind = "binary" if self.binary else "real"
        return f"{kind}, {self.dimensions} axes, resolutions {[level.resolution for level in self.levels]}"


def real_levels(levels: int, coarsest: float, finest: float) -> list[tuple[float, int]]:
    """Scale and resolution of each level of `HashGrid.real_grid`."""
    scales = [coarsest * (finest / coarsest) ** (i / max(levels - 1, 1)) - 1 for i in range(levels)]
    return [(scale, math.ceil(scale - 1e-9) + 1) for scale in scales]  # 39.0000000001 is 39


def table_size(resolution: int, dimensions: int, log2_size: int) -> int:
    """Entries of a level: an entry for every vertex if they fit, a multiple of 8."""
    return -(-min(1 << log2_size, resolution**dimensions) // 8) * 8


def _corners(ends: Sequence[Sequence[Tensor]], combine: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """[n,L,2^d] from two tensors [n,L] for each axis; the first axis changes fastest."""
    found = list(ends[0])
    for axis in ends[1:]:
        found = [combine(one, end) for end in axis for one in found]
    return torch.stack(found, dim=2)
