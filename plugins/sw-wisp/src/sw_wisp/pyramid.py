"""Pyramid of running means: what the splats known so far are like around a place, at the levels of the octree.

Each cell of levels 0 to 15 that a splat lies in holds, of the splats known so far in it (those of its own level and
finer), their number n and the sums of their values and activities. Values v count base steps with 12 fractional bits,
within +-2^20; the activity of an index k is 256 min(|k|, 15). Means are shrunk towards those of the parent cell:

    M_0 = prior,    M_g = floor((sum + 2 M_{g-1}) / (n + 2))

All are whole numbers below 2^53 held as float64, so they are the same in any order of addition and on any device.
Opacity, shape, size and colour have one number n, latents another, since they become known later.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from sw_gaussians.morton import interleave
from torch import Tensor

from sw_wisp.nested import UNIT
from sw_wisp.numbers import HIGHEST_LEVEL, LATENTS, NUMBERS
from sw_wisp.packets import REFINED, default_order, waves

DEEPEST = 15
PULL = 2
"""Splats that the mean of the parent cell counts for."""
VALUE_LIMIT = 1 << 20
MOST_ACTIVE, MOST_COUNTED = 15, 15
EIGHTH = UNIT // 16
"""One unit of activities, levels and counts: a sixteenth."""
FEATURES = 3 * NUMBERS + 3
"""Of a splat of level l: means at level min(l, 15) and at l - 3, activities at l - 1, l, and n at the first two."""
BASE, VIEW = slice(0, LATENTS.columns.start), LATENTS.columns
PARTS = (BASE, VIEW)
WAVES = (6, 4)
"""Parts of the packets of the first subset, and of every other."""


class Pyramid:
    """Sums over the cells on the way to all splats that were announced; rows are numbered as they were announced.

    prior   [22] whole numbers: means where nothing is known
    """

    def __init__(self, prior: Tensor) -> None:
        device = prior.device
        empty = torch.empty(0, dtype=torch.int64, device=device)
        self._levels, self._leaf = empty, empty
        self._keys, self._parent, self._starts = empty, empty, [0] * (DEEPEST + 2)
        self._sums = [torch.zeros(1, 2 * (p.stop - p.start) + 1, dtype=torch.float64, device=device) for p in PARTS]
        self._known = [False, False]
        activity = torch.full((NUMBERS,), EIGHTH, device=device)
        self._prior = [torch.cat([prior[p], activity[p]]).double() for p in PARTS]

    def __len__(self) -> int:
        return len(self._levels)

    def announce(self, levels: Tensor, codes: Tensor) -> None:
        """Further splats: levels int64 [n], and Morton codes [n] of their cells; nothing else of them is known yet."""
        deep = (levels - DEEPEST).clamp_min(0)
        at, codes = levels - deep, codes >> 3 * deep
        keys, way = [], codes[:0]
        for level in range(DEEPEST, -1, -1):
            way = torch.unique(torch.cat([way >> 3, codes[at == level]]))
            keys.append(way | 1 << 3 * level)
        old, self._keys = self._keys, torch.unique(torch.cat([self._keys, *keys]))
        cells = len(self._keys)
        moved = torch.searchsorted(self._keys, old)
        for number, sums in enumerate(self._sums):
            self._sums[number] = sums.new_zeros(cells + 1, sums.shape[1])
            self._sums[number][moved] = sums[:-1]
        parent = torch.searchsorted(self._keys, self._keys >> 3)
        self._parent = torch.cat([parent, parent.new_tensor([cells])])  # the last row is above the root
        self._parent[:1] = cells
        first = torch.tensor([1 << 3 * level for level in range(DEEPEST + 2)], device=self._keys.device)
        self._starts = torch.searchsorted(self._keys, first).tolist()
        leaf = torch.searchsorted(self._keys, codes | 1 << 3 * at)
        self._leaf = torch.cat([moved[self._leaf], leaf])
        self._levels = torch.cat([self._levels, levels])

    def add(self, rows: Tensor, part: slice, values: Tensor, indices: Tensor) -> None:
        """Take in the columns `part`, BASE or VIEW, of splats that became known: values and indices [n,c]."""
        activity = indices.abs().clamp_max(MOST_ACTIVE) * EIGHTH
        table = [bounded(values), activity.double(), values.new_ones(len(rows), 1).double()]
        self._known[PARTS.index(part)] = True
        self._spread(rows, PARTS.index(part), slice(None), torch.cat(table, dim=1))

    def refine(self, rows: Tensor, columns: slice, before: Tensor, after: Tensor) -> None:
        """Values [n,c] of columns of BASE became finer; activities stay what they were."""
        self._spread(rows, 0, columns, bounded(after) - bounded(before))

    def _spread(self, rows: Tensor, part: int, columns: slice, table: Tensor) -> None:
        if not len(rows):
            return
        at, sums = self._leaf[rows], self._sums[part][:, columns]
        for _ in range(int(self._levels[rows].amax().clamp_max(DEEPEST)) + 1):
            sums.index_add_(0, at, table)
            at = self._parent[at]

    def features(self, rows: Tensor) -> Tensor:
        """Features int64 [n,69] of some splats, 12 fractional bits."""
        levels, fine = self._levels[rows], self._leaf[rows]
        ways = [fine]
        for _ in range(3):
            ways.append(self._parent[ways[-1]])
        up = torch.stack(ways, dim=1)  # [n,4] cells
        to_coarse = (levels.clamp_max(DEEPEST) - levels + 3).clamp_min(0)
        coarse = up.gather(1, to_coarse[:, None])[:, 0]
        middle = up.gather(1, (to_coarse - 2).clamp_min(0)[:, None])[:, 0]
        cells, place = self._on_the_way(fine)
        means = [self._means(part, cells, place) for part in range(len(PARTS))]

        def of(nodes: Tensor, activity: bool) -> list[Tensor]:
            half = [slice(m.shape[1] // 2, None) if activity else slice(0, m.shape[1] // 2) for m in means]
            return [m[place[nodes], columns] for m, columns in zip(means, half, strict=True)]

        counts = [self._sums[0][nodes, -1:].clamp_max(MOST_COUNTED) * EIGHTH for nodes in (fine, coarse)]
        found = [*of(fine, False), *of(coarse, False), *of(middle, True), (levels * EIGHTH)[:, None], *counts]
        return torch.cat([each.double() for each in found], dim=1).clamp(-VALUE_LIMIT, VALUE_LIMIT).long()

    def _on_the_way(self, leaves: Tensor) -> tuple[Tensor, Tensor]:
        """Cells [m] that lie above or at some, ascending, and the place of each cell among them [cells + 1]."""
        needed = torch.zeros(len(self._keys) + 1, dtype=torch.bool, device=leaves.device)
        at = leaves
        for _ in range(DEEPEST + 1):
            needed[at] = True
            at = self._parent[at]
        needed[-1] = False
        return needed.nonzero()[:, 0], needed.cumsum(0) - 1

    def _means(self, part: int, cells: Tensor, place: Tensor) -> Tensor:
        """Shrunk means of values and activities [m, 2c] of cells [m]."""
        prior, sums = self._prior[part], self._sums[part]
        if not self._known[part]:
            return prior.expand(len(cells), -1)
        bounds = torch.searchsorted(cells, torch.tensor(self._starts, device=cells.device)).tolist()
        found = sums.new_empty(len(cells), len(prior))
        found[: bounds[1]] = prior
        for level in range(1, DEEPEST + 1):
            own = cells[bounds[level] : bounds[level + 1]]
            known = sums[own]
            above = found[place[self._parent[own]]]
            shrunk = (known[:, :-1] + PULL * above).div_(known[:, -1:] + PULL).floor_()
            found[bounds[level] : bounds[level + 1]] = shrunk
        return found


def bounded(values: Tensor) -> Tensor:
    """Values within +-2^20, so that 2^26 of them stay far below 2^53 in sum."""
    return values.clamp(-VALUE_LIMIT, VALUE_LIMIT).double()


@torch.no_grad()
def walked_features(
    prior: Tensor,
    levels: Tensor,
    cells: Tensor,
    values: Tensor,
    indices: Tensor,
    *,
    labels: Tensor | None = None,
    order: Sequence[tuple[int, str]] | None = None,
    planes: int = 0,
    multipliers: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Features of all splats as a file would have them: for latents and for all before them, each [N,69] float32.

    prior       [22] whole numbers, base steps with 12 fractional bits
    levels      [N] int64, and cells [N,3] int64 at those levels; rows in any order
    values      [N,22] in base steps, as rounded; `indices` [N,22] their steps from the means
    labels      [N] subsets of splats; None: all in one
    order       (subset, kind) of each packet; None: `default_order`
    planes      refinements, and `multipliers` [N,22] steps in base steps; None: 1

    First the features of opacity, shape, size and colour, then those of latents. All tensors on one device.
    """
    codes = interleave(cells)
    by_place = torch.argsort((codes << 3 * (HIGHEST_LEVEL - levels)) * 32 + levels)
    labels = torch.zeros_like(levels) if labels is None else labels
    order = order or default_order(int(labels.max()) + 1 if len(labels) else 1, planes)
    units = (values.double() * UNIT).round()
    steps = torch.full_like(units, UNIT) if multipliers is None else (multipliers.double() * UNIT).round()
    indices = indices.double().round()
    pyramid = Pyramid(prior)
    pyramid.announce(levels, codes)  # cells that hold nothing known change no mean
    found = [torch.zeros(len(levels), FEATURES, device=values.device) for _ in range(2)]
    left: dict[int, int] = {}

    def at_hand(rows: Tensor, missing: int) -> tuple[Tensor, Tensor]:
        """Values and indices of BASE while `missing` refinements of shape, size and colour are not known."""
        index, width = indices[rows, BASE].clone(), 3**missing
        index[:, REFINED] = ((index[:, REFINED] + (width - 1) // 2) / width).floor() * width
        return units[rows, BASE] + (index - indices[rows, BASE]) * steps[rows, BASE], index

    for subset, kind in order:
        rows = by_place[labels[by_place] == subset]
        parts = waves(rows, WAVES[len(left) > 0 and subset != next(iter(left))])
        if kind == "base":
            left[subset] = planes
            for part in parts:
                found[0][part] = pyramid.features(part).float() / UNIT
                pyramid.add(part, BASE, *at_hand(part, planes))
        elif kind == "fine":
            before = at_hand(rows, left[subset])[0][:, REFINED]
            left[subset] -= 1
            pyramid.refine(rows, REFINED, before, at_hand(rows, left[subset])[0][:, REFINED])
        else:
            for part in parts:
                found[1][part] = pyramid.features(part).float() / UNIT
                pyramid.add(part, VIEW, units[part, VIEW], indices[part, VIEW])
    return found[0], found[1]
