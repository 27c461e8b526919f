"""Context model `hash-grid`: multi-resolution grids of learned features, looked up by position.

Two kinds. `HashGrid.binary`: signs of learned numbers, as in HAC (arXiv 2403.14530): vertices on the border do not
take part, the other weights are brought to sum 1, and outside [0,1] all features are 0. `HashGrid.real`: the learned
numbers themselves, as in instant-ngp (arXiv 2201.05989). A level whose vertices all fit its table is dense, any other
is hashed. `MixedHashGrid` puts a binary grid over space and three over its planes side by side.

For files the lookup of 16-bit position codes is done in integers alone (`integer_features`), so that every machine
has the same features. Source: specification of the codec library, context models, and exact mode, rule 2.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sw_codecs.context.grid_lookup import fits_kernel, levels_of, lookup, signs_fit_kernel
from sw_codecs.context.grid_nodes import BinaryLookup, SignLookup, WeightedRows
from sw_codecs.exact_native import EXACT
from sw_codecs.quantizers.binary import SteBinary

PRIMES = (1, 2654435761, 805459861)
INITIAL = 1e-4
FRACTION = 12
POSITION_TOP = 65535
INTEGER_ROWS = 1 << 14
"""Rows of `integer_features` that are looked up together."""
PLACE_ROWS = 1 << 16
"""Rows of `places` that are worked out together."""


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
        self._signs: tuple[tuple[int, int], Tensor] | None = None
        if generator is not None:
            with torch.no_grad():
                self.table.uniform_(-INITIAL, INITIAL, generator=generator)
        # Dense levels come first in the buffers below; `order` brings features back into the order of the levels.
        dense_first = sorted(range(len(self.levels)), key=lambda i: not self.levels[i].dense)
        chosen = [self.levels[i] for i in dense_first]
        self._dense = sum(level.dense for level in chosen)
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
        return SteBinary()(self.table) if self.binary else self.table

    def forward(self, x: Tensor, values: Tensor | None = None) -> Tensor:
        """[n, width]. Differentiable for the table and for x.

        values  `self.values()`, if the caller has them already
        """
        values = self.values() if values is None else values
        n, levels = len(x), len(self.levels)
        if n == 0:
            return values.new_zeros(0, self.width)
        if fits_kernel(self, x, values):
            return lookup(self, x, values)
        index, weights = self._corners_of(x)
        index, weights = index.view(n * levels, -1), weights.to(values.dtype).view(n * levels, -1)
        found = WeightedRows.apply(values, index, weights, levels)
        return self._sorted(found.view(n, levels, self.features))

    @torch.no_grad()
    def places(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Entries of the table (int32) and their weights (dtype of x), both [n, levels, 2^d], levels in their order."""
        index, weights = self._corners_of(x)
        return (index, weights) if self._in_order else (index[:, self._order], weights[:, self._order])

    def _corners_of(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The same in the order of the buffers; weights are differentiable for x."""
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
        if codes.device.type == "cpu" and self.dimensions == 3 and self.features <= 16 and EXACT.try_load():
            found = codes.new_empty(len(codes), self.width, dtype=torch.int64)
            self._kernel_features(codes.to(torch.int64).contiguous(), (0, 1, 2), found, 0)
            return found
        signs = torch.where(self.table.detach() >= 0, 1.0, -1.0).to(torch.float64)
        blocks = [self._integer_block(block, signs) for block in codes.to(torch.int64).split(INTEGER_ROWS)]
        return torch.cat(blocks) if blocks else codes.new_zeros(0, self.width, dtype=torch.int64)

    def _kernel_features(self, codes: Tensor, axes: Sequence[int], into: Tensor, column: int) -> None:
        """Write `integer_features` for some axes of codes int64 [n,3] into columns of `into` from `column` on."""
        order = torch.argsort(self._order)  # buffers hold dense levels first
        levels = torch.stack([self._last, self._start.to(torch.int64), column + order * self.features])
        torch.ops.sw_codecs_exact.grid_features(
            codes, list(axes), self._packed_signs(), self.features, levels, self._dense, self.log2_size, into
        )

    def _packed_signs(self) -> Tensor:
        """[entries] int16: bit f is 1 where number f is not negative; kept as long as the table stays as it is."""
        table = self.table.detach()
        key = (table.data_ptr(), self.table._version)
        if self._signs is None or self._signs[0] != key:
            found = torch.zeros(len(table), dtype=torch.int32)
            for f, column in enumerate(table.unbind(1)):
                found |= (column >= 0).to(torch.int32) << f
            self._signs = (key, found.to(torch.int16))
        return self._signs[1]

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
        return self._sorted(found * inside[:, None, None])

    def _off_border(self, near: Tensor, far: Tensor, lower: Tensor) -> tuple[Tensor, Tensor]:
        """Weights [n,L] of the two ends of an axis, 0 where the end is a border vertex."""
        return near * (lower > 0), far * (lower + 1 < self._last)

    def _entries(self, lower: Sequence[Tensor]) -> Tensor:
        """[n,L,2^d] int32: entries of the table for the corners of cells, [n,L] for each axis; beyond the last vertex
        counts as it."""
        dense, last = self._dense, self._last
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

    def _sorted(self, found: Tensor) -> Tensor:
        """[n, width] from [n,L,F] in the order of the buffers."""
        if not self._in_order:
            found = found[:, self._order]
        return found.reshape(len(found), self.width)

    def extra_repr(self) -> str:
        kind = "binary" if self.binary else "real"
        return f"{kind}, {self.dimensions} axes, resolutions {[level.resolution for level in self.levels]}"


class GridPlaces(NamedTuple):
    """Of n points in a MixedHashGrid: entries (int32, of all its tables in a row) and weights of the corners.

    space, space_weights        [n, levels over space, 8]
    planes, planes_weights      [n, levels over the three planes, 4]
    """

    space: Tensor
    space_weights: Tensor
    planes: Tensor
    planes_weights: Tensor

    def rows(self, rows: Tensor) -> GridPlaces:
        """Those of some of the points."""
        return GridPlaces(*(each.index_select(0, rows) for each in self))


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
        """`entries` of such a grid, before anything is allocated."""
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

    def forward(self, x: Tensor) -> Tensor:
        """[n,3] in [0,1] -> [n, width]."""
        return self.with_bits(x)[0]

    def with_bits(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The features, and the bits of all signs under their own share of ones (+ 32), a differentiable scalar.

        Not differentiable for x.
        """
        if not self.has_kernel(x):
            return self.at_places(self.places(x))
        grids = [(axes, levels_of(grid)) for axes, grid in zip(self.AXES, self._all(), strict=True)]
        tables = [grid.table for grid in self._all()]
        features, bits = SignLookup.apply(x.detach().contiguous(), grids, *tables)
        return features, bits

    def has_kernel(self, x: Tensor) -> bool:
        """Whether `with_bits` of places like `x` works out their corners by a kernel: then nobody need keep them."""
        return signs_fit_kernel(self._all(), x)

    @property
    def corners(self) -> int:
        """Corners of all cells around a place."""
        return sum(len(grid.levels) << grid.dimensions for grid in self._all())

    @property
    def place_bytes(self) -> int:
        """Of `places`, a row."""
        return 8 * self.corners

    @torch.no_grad()
    def places(self, x: Tensor) -> GridPlaces:
        """Entries and weights of places [n,3] in [0,1], which training does not change."""
        blocks = map(self._places, x.split(PLACE_ROWS))
        first = next(blocks)
        if len(first.space) == len(x):
            return first
        # Written in place: joined afterwards, all of it would be there twice.
        found, start = GridPlaces(*(each.new_empty(len(x), *each.shape[1:]) for each in first)), 0
        for block in itertools.chain([first], blocks):
            for whole, part in zip(found, block, strict=True):
                whole[start : start + len(part)] = part
            start += len(part)
        return found

    def _places(self, x: Tensor) -> GridPlaces:
        start, found = 0, []
        for grid, axes in zip(self._all(), self.AXES, strict=True):
            index, weights = grid.places(x[:, list(axes)])
            found.append((index + start, weights))
            start += len(grid.table)
        planes = [torch.cat([each[i] for each in found[1:]], dim=1) for i in (0, 1)]
        return GridPlaces(*found[0], *planes)

    def at_places(self, places: GridPlaces) -> tuple[Tensor, Tensor]:
        """`with_bits` of what `places` was made from."""
        features, bits = BinaryLookup.apply(*places, *(grid.table for grid in self._all()))
        return features, bits

    def integer_features(self, codes: Tensor, dtype: torch.dtype = torch.int64) -> Tensor:
        """[n,3] 16-bit codes -> [n, width] with 12 fractional bits, at most 1 in magnitude: int64, or int16."""
        first = self._all()[0]
        if codes.device.type == "cpu" and first.features <= 16 and EXACT.try_load():
            codes, column = codes.to(torch.int64).contiguous(), 0
            found = codes.new_empty(len(codes), self.width, dtype=dtype)
            for grid, axes in zip(self._all(), self.AXES, strict=True):
                grid._kernel_features(codes, axes, found, column)
                column += grid.width
            return found
        return torch.cat(
            [grid.integer_features(codes[:, list(axes)]) for grid, axes in zip(self._all(), self.AXES, strict=True)],
            dim=1,
        ).to(dtype)

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
