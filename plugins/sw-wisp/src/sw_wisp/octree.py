"""Position codec `leaf-octree`: splats at the centres of cells of any level, as bits of an octree, breadth first.

A splat of level l, 3 to 18, sits at the centre of a cell of edge root edge / 2^l; a cell may hold up to 16 of them and
have finer cells below. Rows stand in Morton order of the cells' low corners, coarse before fine.

For each level, nodes in Morton order: the bits of child 0 of every node, then of child 1, ... to 7; for each child that
is occupied the flags "a splat ends here", "another one ends here" in unary, "it also goes on". Each bit has a stored
probability by its context (`octree_contexts`). The 64 nodes of level 2 are there without saying so. A node of level 3
and up has a child, so after seven zeros the last bit is not coded; at level 18 every child ends, and none goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.positions import morton
from sw_wisp.fast.streams import FastReader
from sw_wisp.nested import UNIT, Stream
from sw_wisp.numbers import HIGHEST_LEVEL, LOWEST_LEVEL
from sw_wisp.octree_contexts import CONTEXTS, ENDS, LEVELS, MORE, ON, Around, Shares

MOST_IN_A_CELL, EVERY_LEVEL = 16, range(LOWEST_LEVEL, HIGHEST_LEVEL + 1)


@dataclass(frozen=True)
class Cells:
    """Cells of the splats, in the order of the file.

    levels  [N] int64, 3..18
    codes   [N] int64, Morton codes of their cells at that level, below 8^level
    """

    levels: np.ndarray
    codes: np.ndarray

    def __len__(self) -> int:
        return len(self.levels)

    @property
    def places(self) -> np.ndarray:
        """Cells int64 [N,3] at each splat's level."""
        return morton.decode(self.codes)

    @property
    def finest(self) -> np.ndarray:
        """Morton codes int64 [N] of the low corners at level 18."""
        return self.codes << (3 * (HIGHEST_LEVEL - self.levels))

    def part(self, rows: slice | np.ndarray) -> Cells:
        """Some of the rows."""
        return Cells(self.levels[rows], self.codes[rows])

    def at(self, level: int) -> np.ndarray:
        """Codes at `level` of the splats that sit there or deeper, in the order of the rows."""
        there = self.levels >= level
        return self.codes[there] >> (3 * (self.levels[there] - level))


def joined(parts: Sequence[Cells]) -> Cells:
    """All rows of several parts."""
    empty = np.empty(0, np.int64)
    return Cells(*(np.concatenate([empty, *(getattr(p, name) for p in parts)]) for name in ("levels", "codes")))


def file_order(levels: np.ndarray, places: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Rows int64 [N] in the order of the file: Morton, coarse before fine, opaque first within a cell.

    levels [N] in 3..18, places [N,3] cells at those levels, opacities [N] of any kind that rises with opacity
    """
    cells = Cells(np.asarray(levels, np.int64), morton.encode(places))
    return np.lexsort((-np.asarray(opacities, np.float64), cells.levels, cells.finest))


def spread_crowds(levels: np.ndarray, codes_at_18: np.ndarray, opacities: np.ndarray) -> np.ndarray:
    """Levels [N] such that no cell holds more than 16 splats: the least opaque go a level deeper, from 18 up.

    codes_at_18     [N] int64, Morton codes of the splats' places at level 18

    Raises ValueError if more splats share a place than its cells of all levels have room for.
    """
    levels = np.array(levels, np.int64)
    down = list(range(LOWEST_LEVEL, HIGHEST_LEVEL))
    for level, target in [*((at, at + 1) for at in down), *((at + 1, at) for at in reversed(down))]:
        rows = np.flatnonzero(levels == level)
        cell = codes_at_18[rows] >> (3 * (HIGHEST_LEVEL - level))
        order = np.lexsort((-np.asarray(opacities, np.float64)[rows], cell))
        first = np.flatnonzero(np.diff(cell[order], prepend=-1))
        rank = np.arange(len(rows)) - np.repeat(first, np.diff(first, append=len(rows)))
        levels[rows[order[rank >= MOST_IN_A_CELL]]] = target
    coarsest = codes_at_18[levels == LOWEST_LEVEL] >> (3 * (HIGHEST_LEVEL - LOWEST_LEVEL))
    if np.bincount(coarsest).max(initial=0) > MOST_IN_A_CELL:
        raise ValueError("more splats share one place than cells have room for: merge splats at the same place first")
    return levels


class Code(Protocol):
    """Codes one pass: bits [n] bool under contexts int64 [n]; `wanted` is None where they are read."""

    def __call__(self, contexts: np.ndarray, wanted: np.ndarray | None) -> np.ndarray: ...


class _Known:
    """Splats of earlier subsets: how many are in a cell, 0, 1 or more."""

    def __init__(self, earlier: Cells) -> None:
        self._earlier = earlier

    def classes(self, level: int, codes: np.ndarray) -> np.ndarray:
        """0, 1 or 2 (int64) in the shape of `codes` at `level`."""
        if not len(self._earlier):
            return np.zeros(codes.shape, np.int64)
        cells, counts = np.unique(self._earlier.at(level), return_counts=True)
        if not len(cells):
            return np.zeros(codes.shape, np.int64)
        place = np.minimum(np.searchsorted(cells, codes), len(cells) - 1)
        return np.where(cells[place] == codes, np.minimum(counts[place], 2), 0)


class _Truth:
    """A subset as the walk needs it: which cells of a level are occupied, how many splats end there, which go on."""

    def __init__(self, cells: Cells, level: int) -> None:
        deeper = cells.at(level)  # ascending
        self.cells = deeper[np.diff(deeper, prepend=-1) != 0]
        here = np.searchsorted(self.cells, cells.codes[cells.levels == level])
        self.ending = np.bincount(here, minlength=len(self.cells))
        self.inside = np.bincount(np.searchsorted(self.cells, deeper), minlength=len(self.cells))
        self.goes_on = self.inside > self.ending

    def holds(self, children: np.ndarray) -> np.ndarray:
        """Occupied cells among `children`, of this level: bool in their shape."""
        place = np.minimum(np.searchsorted(self.cells, children), len(self.cells) - 1)
        found: np.ndarray = self.cells[place] == children
        return found


def walk(
    code: Code, rows: int, earlier: Cells, wanted: Cells | None, prices: np.ndarray | None = None
) -> tuple[Cells, np.ndarray]:
    """Code one subset; the cells that were coded, in the order of the file, and what each splat cost.

    rows        splats of the subset; 0: nothing is coded
    earlier     cells of the subsets before it
    wanted      the subset, in the order of the file; None: it is read
    prices      [16 * 41, 2] bits of a 0 and a 1 by level and context; None: the costs are 0

    A splat costs its share of every bit on its way: those of a cell are divided among the splats that need them.
    Raises BitstreamError if what is read is no subset of `rows` splats.
    """
    prices = np.zeros((LEVELS * CONTEXTS, 2)) if prices is None else prices
    known = _Known(earlier)
    nodes = np.arange(64 if rows else 0)
    paid = np.zeros(64)  # by each splat in the node, so far
    inside = np.ones(64) if wanted is None else np.bincount(wanted.at(LOWEST_LEVEL - 1), minlength=64)
    found, costs, left = [Cells(np.empty(0, np.int64), np.empty(0, np.int64))], [np.empty(0)], rows
    for level in EVERY_LEVEL:
        if not len(nodes):
            break
        base, truth = (level - LOWEST_LEVEL) * CONTEXTS, None if wanted is None else _Truth(wanted, level)

        def ask(contexts: np.ndarray, at: np.ndarray, cost: np.ndarray, answer: np.ndarray | None) -> np.ndarray:
            """Code a bit for the nodes or children `at`, [n] of them, and add what it costs to theirs."""
            bits = code(base + contexts, answer)  # noqa: B023 (used within this turn)
            cost[at] += prices[base + contexts, bits.astype(np.int64)]  # noqa: B023
            return bits

        children = nodes[:, None] * 8 + np.arange(8)  # [M, 8]
        classes, occupied = known.classes(level, children), None if truth is None else truth.holds(children)
        around = Around(nodes, level - 1)
        bits, cost = around.bits, np.zeros(len(nodes))
        for child in range(8):
            asked = np.arange(len(nodes))
            if child == 7 and level > LOWEST_LEVEL:
                some = bits[:, :7].any(1)
                bits[~some, 7] = True
                asked = np.flatnonzero(some)
            contexts = around.contexts(child, classes[:, child])[asked]
            answer = None if occupied is None else occupied[asked, child]
            bits[asked, child] = ask(contexts, asked, cost, answer)
        place = np.flatnonzero(bits)
        parent, classes = place >> 3, classes.reshape(-1)[place]
        nodes = children.reshape(-1)[place]
        empty = cost[inside == 0].sum() / rows  # of nodes of level 2 with nothing in them
        paid = (paid + cost / np.maximum(inside, 1))[parent] + empty

        cost = np.zeros(len(nodes))
        ends, goes_on = np.ones(len(nodes), bool), np.zeros(len(nodes), bool)
        if level < HIGHEST_LEVEL:
            every = np.arange(len(nodes))
            ends = ask(ENDS + classes, every, cost, None if truth is None else truth.ending > 0)
        count, active = ends.astype(np.int64), np.flatnonzero(ends)
        for number in range(1, MOST_IN_A_CELL):
            answer = None if truth is None else truth.ending[active] > number
            active = active[ask(np.full(len(active), MORE), active, cost, answer)]
            count[active] += 1
        if level < HIGHEST_LEVEL:
            goes_on, asked = ~ends, np.flatnonzero(ends)
            goes_on[asked] = ask(np.full(len(asked), ON), asked, cost, None if truth is None else truth.goes_on[asked])
        inside = np.ones(len(nodes)) if truth is None else truth.inside
        paid = paid + cost / inside
        found.append(Cells(np.full(int(count.sum()), level), np.repeat(nodes, count)))
        costs.append(np.repeat(paid, count))
        nodes, paid = nodes[goes_on], paid[goes_on]
        inside = (inside - count)[goes_on]
        left -= int(count.sum())
        if left < len(nodes):
            raise BitstreamError(f"the octree has more than the {rows:,} splats that were announced")
    if left:
        raise BitstreamError(f"the octree has fewer than the {rows:,} splats that were announced")
    cells = joined(found)
    order = np.lexsort((cells.levels, cells.finest))
    return cells.part(order), np.concatenate(costs)[order]


def fit_shares(subsets: Sequence[Cells]) -> Shares:
    """Probabilities that code these subsets, one after another, in the fewest bits."""
    counts = np.zeros((LEVELS * CONTEXTS, 2), np.int64)

    def tally(contexts: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        assert wanted is not None
        counts[:, 1] += np.bincount(contexts[wanted], minlength=len(counts))
        counts[:, 0] += np.bincount(contexts[~wanted], minlength=len(counts))
        return wanted

    for number, subset in enumerate(subsets):
        walk(tally, len(subset), joined(subsets[:number]), subset)
    return Shares.fitted(counts)


def code_cells(stream: Stream, shares: Shares, rows: int, earlier: Cells, wanted: Cells | None) -> Cells:
    """Write, read or count one subset; see `walk`."""
    if isinstance(stream, FastReader) and rows:
        return Cells(*stream.leaf_octree(shares.ones, rows, [earlier.at(level) for level in EVERY_LEVEL]))
    return walk(lambda contexts, bits: stream.bits(shares.ones[contexts], bits), rows, earlier, wanted)[0]


def position_bits(cells: Cells) -> np.ndarray:
    """Bits float64 [N] of each splat's place, in the order of the rows; their sum is what the octree takes.

    One subset; rows in any order.
    """
    order = np.lexsort((cells.levels, cells.finest))
    ordered = cells.part(order)
    ones = fit_shares([ordered]).ones
    prices = -np.log2(np.stack([UNIT - ones, ones], axis=1) / UNIT)
    spent = np.empty(len(cells))
    spent[order] = walk(lambda _, bits: _given(bits), len(cells), joined([]), ordered, prices)[1]
    return spent


def _given(bits: np.ndarray | None) -> np.ndarray:
    assert bits is not None
    return bits
