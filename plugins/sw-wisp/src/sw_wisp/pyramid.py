"""Pyramid of running means: what the splats known so far are like around a place, at the levels of the octree.

Each cell of levels 0 to 15 that two splats or more lie in holds, of those known so far (of its own level and finer),
their number n and the sums of their values and activities. Values v count base steps with 12 fractional bits, within
+-2^20; the activity of an index k is 256 min(|k|, 15). Means are shrunk towards those of the parent cell:

    M_0 = prior,    M_g = floor((sum + 2 M_{g-1}) / (n + 2)),    M_g = M_{g-1} in a cell of a single splat

All are whole numbers below 2^53 held as float64, so they are the same in any order of addition and on any device.
Opacity, shape, size and colour have one number n, latents another, since they become known later.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from sw_gaussians.morton import interleave
from torch import Tensor

from sw_wisp.nested import UNIT
from sw_wisp.numbers import HIGHEST_LEVEL, LATENTS, NUMBERS
from sw_wisp.packets import REFINED, VALUE_LIMIT, default_order, waves

DEEPEST = 15
PULL = 2
"""Splats that the mean of the parent cell counts for."""
MOST_ACTIVE, MOST_COUNTED = 15, 15
SIXTEENTH = UNIT // 16
"""Unit of activities, levels and counts."""
FEATURES = 3 * NUMBERS + 3
"""Of a splat of level l: means at level min(l, 15) and at l - 3, activities at l - 1, l, and n at the first two."""
BASE, VIEW = slice(0, LATENTS.columns.start), LATENTS.columns
PARTS = (BASE, VIEW)
WAVES = (6, 4)
"""Parts of the packets of the first subset, and of every other."""


class Pyramid:
    """Sums over the cells around all splats that were announced; rows are numbered as they were announced.

    prior   [22] whole numbers: means where nothing is known
    """

    def __init__(self, prior: Tensor) -> None:
        device = prior.device
        empty = torch.empty(0, dtype=torch.int64, device=device)
        self._levels, self._codes, self._leaf = empty, empty, empty  # of rows; codes at level 15
        self._keys, self._parent, self._depth, self._starts = empty, empty, empty, [0] * (DEEPEST + 2)  # of cells
        widths = [2 * (part.stop - part.start) + 1 for part in PARTS]
        self._own = [torch.zeros(0, width, device=device) for width in widths]  # of rows, exact: below 2^24
        self._sums = [torch.zeros(1, width, dtype=torch.float64, device=device) for width in widths]
        self._known = [False, False]
        activity = torch.full((NUMBERS,), SIXTEENTH, device=device)
        self._prior = [torch.cat([prior[p], activity[p]]).double() for p in PARTS]

    def __len__(self) -> int:
        return len(self._levels)

    def announce(self, levels: Tensor, codes: Tensor) -> None:
        """Further splats: levels int64 [n], and Morton codes [n] of their cells; nothing else of them is known yet."""
        before, deep = len(self), (levels - DEEPEST).clamp_min(0)
        self._codes = torch.cat([self._codes, codes >> 3 * deep << 3 * (DEEPEST - levels + deep)])
        self._levels = torch.cat([self._levels, levels])
        self._own = [torch.cat([own, own.new_zeros(len(levels), own.shape[1])]) for own in self._own]
        old = self._keys
        self._find_cells()
        cells, place = len(self._keys), torch.searchsorted(self._keys, old)
        is_new = torch.ones(cells + 1, dtype=torch.bool, device=old.device)
        is_new[place], is_new[-1] = False, False
        for number, sums in enumerate(self._sums):
            self._sums[number] = sums.new_zeros(cells + 1, sums.shape[1])
            self._sums[number][place] = sums[:-1]
        rows = torch.arange(before, device=old.device)
        at = self._leaf[:before]
        while len(rows):  # cells that one splat lay in so far
            inside = is_new[at]
            rows, at = rows[inside], at[inside]
            for sums, own in zip(self._sums, self._own, strict=True):
                sums.index_add_(0, at, own[rows].double())
            at = self._parent[at]

    def _find_cells(self) -> None:
        """Cells of two splats or more, by level and code; their parents; the finest of them around each splat."""
        order = torch.argsort(self._codes, stable=True)
        codes, levels = self._codes[order], self._levels[order].clamp_max(DEEPEST)
        keys, starts = [codes.new_ones(min(len(codes), 1))], [0, min(len(codes), 1)]
        self._leaf = torch.zeros_like(codes)
        for level in range(1, DEEPEST + 1):
            within = levels >= level
            order, codes, levels = order[within], codes[within], levels[within]
            cells, place, counts = torch.unique_consecutive(
                codes >> 3 * (DEEPEST - level), return_inverse=True, return_counts=True
            )
            shared = counts > 1
            keys.append(cells[shared] | 1 << 3 * level)
            number = starts[-1] + shared.cumsum(0) - 1
            within = shared[place]
            order, codes, levels = order[within], codes[within], levels[within]
            self._leaf[order] = number[place[within]]
            starts.append(starts[-1] + len(keys[-1]))
        self._keys, self._starts = torch.cat(keys), starts
        parent = torch.searchsorted(self._keys, self._keys >> 3)
        parent[:1] = len(parent)  # a row above the root, which nothing reads
        self._parent = torch.cat([parent, parent.new_tensor([len(parent)])])
        sizes = torch.tensor(starts, device=parent.device).diff()
        self._depth = torch.repeat_interleave(torch.arange(DEEPEST + 1, device=parent.device), sizes)

    def add(self, rows: Tensor, part: slice, values: Tensor, indices: Tensor) -> None:
        """Take in the columns `part`, BASE or VIEW, of splats that became known: values and indices [n,c]."""
        activity = indices.abs().clamp_max(MOST_ACTIVE) * SIXTEENTH
        table = torch.cat([bounded(values), activity.double(), activity.new_ones(len(rows), 1).double()], dim=1)
        self._known[PARTS.index(part)] = True
        self._spread(rows, PARTS.index(part), slice(None), table)

    def refine(self, rows: Tensor, columns: slice, before: Tensor, after: Tensor) -> None:
        """Values [n,c] of columns of BASE became finer; activities stay what they were."""
        self._spread(rows, 0, columns, bounded(after) - bounded(before))

    def _spread(self, rows: Tensor, part: int, columns: slice, table: Tensor) -> None:
        if not len(rows):
            return
        self._own[part][rows, columns] += table.float()
        cells = table.new_zeros(len(self._parent), table.shape[1]).index_add_(0, self._leaf[rows], table)
        for level in range(DEEPEST, 0, -1):  # each cell's sum to its parent
            own = slice(self._starts[level], self._starts[level + 1])
            cells.index_add_(0, self._parent[own], cells[own].clone())
        self._sums[part][:, columns] += cells

    def features(self, rows: Tensor) -> Tensor:
        """Features int64 [n,69] of some splats, 12 fractional bits."""
        levels, leaf = self._levels[rows], self._leaf[rows]
        depth = self._depth[leaf]
        ways = [leaf]
        for _ in range(3):
            ways.append(self._parent[ways[-1]])
        up = torch.stack(ways, dim=1)  # [n,4] cells

        def around(level: Tensor) -> Tensor:
            """The finest shared cell [n] around each splat, of this level at most."""
            return up.gather(1, (depth - level).clamp_min(0)[:, None])[:, 0]

        fine, coarse = levels.clamp_max(DEEPEST), levels - 3
        cells, place = self._on_the_way(leaf)
        limit = VALUE_LIMIT
        means = [self._means(part, cells, place).clamp(-limit, limit).long() for part in range(len(PARTS))]

        def of(level: Tensor, activity: bool) -> list[Tensor]:
            at = place[around(level)]
            half = [slice(m.shape[1] // 2, None) if activity else slice(0, m.shape[1] // 2) for m in means]
            return [m[:, columns][at] for m, columns in zip(means, half, strict=True)]

        counts = [
            (self._sums[0][around(level), -1] * (depth >= level)).clamp_max(MOST_COUNTED)[:, None].long() * SIXTEENTH
            for level in (fine, coarse)
        ]
        found = [*of(fine, False), *of(coarse, False), *of((levels - 1).clamp_max(DEEPEST), True)]
        return torch.cat([*found, (levels * SIXTEENTH)[:, None], *counts], dim=1)

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
    prefixes: bool = False,
    make: Callable[[Tensor], Pyramid] = Pyramid,
) -> tuple[Tensor, ...]:
    """Features of all splats as a file would have them: for latents and for all before them, each [N,69] float32.

    prior       [22] whole numbers, base steps with 12 fractional bits
    levels      [N] int64, and cells [N,3] int64 at those levels; rows in any order
    values      [N,22] in base steps, as rounded; `indices` [N,22] their steps from the means
    labels      [N] subsets of splats; None: all in one
    order       (subset, kind) of each packet; None: `default_order`. Where it lacks a `view`, as a prefix does, latents
                are predicted at the end, as decoders do
    planes      refinements, and `multipliers` [N,22] steps in base steps; None: 1

    prefixes    return a third [N,K,69]: those of latents after packets that end before `view`, in turn, where
                `prefix_slots` says

    Those of latents come second. All tensors on one device. `make`: the class, or `running_means.pyramid_of`.
    """
    codes = interleave(cells)
    by_place = torch.argsort((codes << 3 * (HIGHEST_LEVEL - levels)) * 32 + levels, stable=True)
    labels = torch.zeros_like(levels) if labels is None else labels
    order = order or default_order(int(labels.max()) + 1 if len(labels) else 1, planes)
    units = (values.double() * UNIT).round()
    steps = torch.full_like(units, UNIT) if multipliers is None else (multipliers.double() * UNIT).round()
    indices = indices.double().round()
    pyramid = make(prior)
    found = [torch.zeros(len(levels), FEATURES, device=values.device) for _ in range(2)]
    left: dict[int, int] = {}
    slots = prefix_slots(order)
    early = found[0].new_zeros(len(levels), max(map(max, slots), default=0) if prefixes else 0, FEATURES)
    number = torch.empty_like(levels)  # of each row in the pyramid

    def at_hand(rows: Tensor, missing: int) -> tuple[Tensor, Tensor]:
        """Values and indices of BASE while `missing` refinements of shape, size and colour are not known."""
        index, width = indices[rows, BASE].clone(), 3**missing
        index[:, REFINED] = ((index[:, REFINED] + (width - 1) // 2) / width).floor() * width
        return units[rows, BASE] + (index - indices[rows, BASE]) * steps[rows, BASE], index

    for known, (subset, kind) in enumerate(order, 1):
        rows = by_place[labels[by_place] == subset]
        parts = waves(rows, WAVES[len(left) > 0 and subset != next(iter(left))])
        if kind == "base":
            left[subset] = planes
            number[rows] = torch.arange(len(pyramid), len(pyramid) + len(rows), device=rows.device)
            pyramid.announce(levels[rows], codes[rows])
            for part in parts:
                found[0][part] = pyramid.features(number[part]).float() / UNIT
                pyramid.add(number[part], BASE, *at_hand(part, planes))
        elif kind == "fine":
            before = at_hand(rows, left[subset])[0][:, REFINED]
            left[subset] -= 1
            pyramid.refine(number[rows], REFINED, before, at_hand(rows, left[subset])[0][:, REFINED])
        else:
            for part in parts:
                found[1][part] = pyramid.features(number[part]).float() / UNIT
                pyramid.add(number[part], VIEW, units[part, VIEW], indices[part, VIEW])
        for waiting, slot in enumerate(slots[known]):
            if slot and prefixes:
                rows = by_place[labels[by_place] == waiting]
                early[rows, slot - 1] = pyramid.features(number[rows]).float() / UNIT
    unseen = [subset for subset in left if (subset, "view") not in order]
    if unseen:
        rows = by_place[torch.isin(labels[by_place], torch.tensor(unseen, device=labels.device))]
        found[1][rows] = pyramid.features(number[rows]).float() / UNIT
    return (*found, early) if prefixes else (*found,)


def prefix_slots(order: Sequence[tuple[int, str]]) -> list[list[int]]:
    """Return for 0, 1, ... packets and each subset the number, from 1 on, of prefixes that have lacked its `view`.

    0 where the `view` is there, or nothing of the subset is.
    """
    found = [[0] * (max((subset for subset, _ in order), default=0) + 1)]
    waiting: dict[int, int] = {}
    for subset, kind in order:
        waiting |= {subset: 0} if kind == "base" else {}
        if kind == "view":
            del waiting[subset]
        waiting = {each: count + 1 for each, count in waiting.items()}
        found.append([waiting.get(each, 0) for each in range(len(found[0]))])
    return found
