"""Walk through the packets of a file: the same steps write, count and read them.

A packet of kind `base` holds the octree of one subset of splats, their opacity at its full step and the coarse indices
of shape, size and colour (steps of 3^planes Q); `fine` refines these by a factor 3; `view` holds the latents. With
planes = 0 `base` has the indices themselves and there is no `fine`. What predicts a packet stands before it in the
file, so every prefix of whole packets decodes to what it holds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.entropy.exact_tables import LEVELS
from sw_wisp.fast.forecasts import kept as fast_kept
from sw_wisp.fast.forecasts import values as fast_values
from sw_wisp.nested import THIRD_OF_SCALE, UNIT, Stream, coarser, table_levels
from sw_wisp.numbers import BLOCKS, COLOUR, LATENTS, NUMBERS, OPACITY, PARTS, SHAPE
from sw_wisp.octree import Cells, code_cells, joined
from sw_wisp.octree_contexts import Shares

KINDS = ("base", "fine", "view")
PARAMETERS = ("mean", "scale", "multiplier")
REFINED = slice(SHAPE.columns.start, COLOUR.columns.stop)
"""Columns that `base` holds coarsely: shape, size, colour."""
VALUE_LIMIT = 1 << 20
"""Predicted means, and values that predict, stay within this many 1/4096 base steps."""
HIGHEST_SCALE = (LEVELS - 1) * UNIT
MOST_SUBSETS, MOST_PLANES = 16, 2


@dataclass(frozen=True)
class Packet:
    """One entry of the order list: which subset, what of it, and how many splats the subset has."""

    subset: int
    kind: str
    rows: int


@dataclass(frozen=True)
class Prediction:
    """Distributions of numbers [n,c], int64: mean and scale level with 12 fractional bits, step multiplier."""

    mean: np.ndarray
    scale: np.ndarray
    multiplier: np.ndarray

    def part(self, columns: slice) -> Prediction:
        """Return the prediction of some columns."""
        return Prediction(self.mean[:, columns], self.scale[:, columns], self.multiplier[:, columns])


@dataclass
class State:
    """Integers of the splats known so far, in the order of the file; rows grow with each `base`.

    cells       where they are
    mean, scale, multiplier     [N,22] int32, the predictions under which they were coded
    index       [N,22] int32, steps from the mean; while only a coarse index c is known, 3^planes c
    planes      [N] int8, refinements of shape, size and colour that are not known yet
    has_view    [N] bool, whether latents are known
    """

    cells: Cells = field(default_factory=lambda: joined([]))
    mean: np.ndarray = field(default_factory=lambda: _none(np.int32))
    scale: np.ndarray = field(default_factory=lambda: _none(np.int32))
    multiplier: np.ndarray = field(default_factory=lambda: _none(np.int32))
    index: np.ndarray = field(default_factory=lambda: _none(np.int32))
    planes: np.ndarray = field(default_factory=lambda: np.empty(0, np.int8))
    has_view: np.ndarray = field(default_factory=lambda: np.empty(0, bool))

    @property
    def levels(self) -> np.ndarray:
        """Levels int64 [N]."""
        return self.cells.levels

    def append(self, cells: Cells, planes: int) -> np.ndarray:
        """Rows int64 of the splats that begin here."""
        start, more = len(self.cells), len(cells)
        self.cells = joined([self.cells, cells])
        for name in (*PARAMETERS, "index"):
            known, table = getattr(self, name), np.zeros((start + more, NUMBERS), np.int32)
            table[:start] = known
            setattr(self, name, table)
        self.planes = np.concatenate([self.planes, np.full(more, planes, np.int8)])
        self.has_view = np.concatenate([self.has_view, np.zeros(more, bool)])
        return np.arange(start, start + more)

    def units(self, rows: np.ndarray, columns: slice) -> np.ndarray:
        """Known values int64 [n,c] in base steps with 12 fractional bits."""
        at = even(rows)
        found = fast_values(at, columns, self.mean, self.index, self.multiplier)
        if found is not None:
            return found
        return self.mean[at, columns] + self.index[at, columns] * self.multiplier[at, columns].astype(np.int64)


class Context(Protocol):
    """Prediction of numbers from the splats before them; `waves`: parts of the first packet and of every other."""

    kind: str
    waves: tuple[int, int]

    def start(self) -> None:
        """A walk begins: forget the splats of the one before."""

    def predict(self, block: slice, rows: np.ndarray, state: State) -> Prediction:
        """Distributions of the columns `block` of splats `rows`, all blocks before it known."""

    def moved(self, part: slice, rows: np.ndarray, state: State) -> np.ndarray | None:
        """Additions [2,n,c] of the parts of a block before it to means and scales of `part`; None: nothing."""

    def changed(self, rows: np.ndarray, columns: slice, before: np.ndarray | None, state: State) -> None:
        """Take note that `columns` of splats became known, or finer than `before` [n,c]."""

    def pack(self) -> bytes:
        """Bytes of the section `networks` that it is read from."""


Choose = Callable[[np.ndarray, slice, Prediction], np.ndarray]
"""(rows, columns, prediction) -> indices [n,c] of an encoder."""


class Walk:
    """Codes packets one after another; `state` is what is known after them.

    context     predicts
    shares      probabilities of the octree
    planes      refinements that follow each `base`
    subsets     cells of each subset, in the order of their bases; None: they are read
    choose      indices for a prediction; None: they are read
    """

    def __init__(
        self,
        context: Context,
        shares: Shares,
        planes: int,
        subsets: Sequence[Cells] | None = None,
        choose: Choose | None = None,
    ) -> None:
        self.state = State()
        self._context, self._shares, self._planes = context, shares, planes
        context.start()
        self._subsets, self._choose = subsets, choose
        self._rows: dict[int, np.ndarray] = {}
        self._chosen = np.empty((0, NUMBERS), np.int32)  # whole indices, where `choose` gives them

    def packet(self, stream: Stream, packet: Packet) -> None:
        """Code one packet. Raises BitstreamError if what is read is none."""
        if packet.kind == "base":
            self._base(stream, packet)
        elif packet.kind == "fine":
            self._fine(stream, self._rows[packet.subset])
        else:
            self._view(stream, self._rows[packet.subset])

    def finish(self) -> None:
        """Predict latents that no packet holds, from all that is known: they stand at their means."""
        rows = np.flatnonzero(~self.state.has_view)
        if len(rows):
            found = self._context.predict(LATENTS.columns, rows, self.state)
            kept(found, 0, None, LATENTS.columns, rows, self.state, 0)

    def _base(self, stream: Stream, packet: Packet) -> None:
        state, number = self.state, len(self._rows)
        wanted = None if self._subsets is None else self._subsets[number]
        rows = state.append(code_cells(stream, self._shares, packet.rows, state.cells, wanted), self._planes)
        self._rows[packet.subset] = rows
        if self._choose is not None:
            self._chosen = np.concatenate([self._chosen, np.zeros((len(rows), NUMBERS), np.int32)])
        for wave in self._waves(rows):
            for block in BLOCKS[:-1]:
                self._block(stream, block, wave, 0 if block == OPACITY.columns else self._planes)
            self._context.changed(wave, slice(0, LATENTS.columns.start), None, state)

    def _block(self, stream: Stream, block: slice, rows: np.ndarray, planes: int) -> None:
        if not len(rows):
            return
        found = self._context.predict(block, rows, self.state)
        for part in PARTS[BLOCKS.index(block)]:
            more = self._context.moved(part, rows, self.state)
            tables = kept(found, part.start - block.start, more, part, rows, self.state, planes)
            self._code(stream, part, rows, tables, planes)

    def _code(self, stream: Stream, part: slice, rows: np.ndarray, tables: np.ndarray, planes: int) -> None:
        if self._choose is not None:
            known = (getattr(self.state, name)[rows, part].astype(np.int64) for name in PARAMETERS)
            self._chosen[rows, part] = self._choose(rows, part, Prediction(*known))
        wanted = self._coarse(rows, part, planes)
        self.state.index[even(rows), part] = stream.indices(tables, wanted) * 3**planes

    def _coarse(self, rows: np.ndarray, columns: slice, planes: int) -> np.ndarray | None:
        """Indices that an encoder writes, coarser `planes` times."""
        if self._choose is None:
            return None
        chosen = self._chosen[rows, columns].astype(np.int64)
        for _ in range(planes):
            chosen = coarser(chosen)
        return chosen

    def _fine(self, stream: Stream, rows: np.ndarray) -> None:
        if not len(rows):
            return
        state, planes = self.state, int(self.state.planes[rows[0]]) - 1
        before = state.units(rows, REFINED)
        coarse = state.index[rows, REFINED].astype(np.int64) // 3 ** (planes + 1)
        finer = self._coarse(rows, REFINED, planes)
        tables = table_levels(state.scale[rows, REFINED], planes)
        trits = stream.trits(tables, coarse, None if finer is None else finer - 3 * coarse)
        state.index[rows, REFINED] = (3 * coarse + trits) * 3**planes
        state.planes[rows] = planes
        self._context.changed(rows, REFINED, before, state)

    def _view(self, stream: Stream, rows: np.ndarray) -> None:
        for wave in self._waves(rows):
            self._block(stream, LATENTS.columns, wave, 0)
            self.state.has_view[wave] = True
            self._context.changed(wave, LATENTS.columns, None, self.state)

    def _waves(self, rows: np.ndarray) -> list[np.ndarray]:
        """Parts of the rows of one subset."""
        is_first = len(rows) > 0 and rows[0] == 0
        return waves(rows, self._context.waves[not is_first])


def kept(
    found: Prediction, begin: int, moved: np.ndarray | None, columns: slice, rows: np.ndarray, state: State, planes: int
) -> np.ndarray:
    """Keep in `state` what predicts `columns` of splats `rows`; return the tables uint8 [n,c] that code them.

    found   of a block whose column `begin` is the first of them
    moved   [2,n,c] additions to means and scale levels; None: nothing
    planes  how often their step is tripled
    """
    at = even(rows)
    tables = fast_kept(found, begin, moved, columns, at, state, planes * THIRD_OF_SCALE)
    if tables is not None:
        return tables
    own = found.part(slice(begin, begin + columns.stop - columns.start))
    mean, scale = (own.mean, own.scale) if moved is None else (own.mean + moved[0], own.scale + moved[1])
    state.mean[at, columns] = np.clip(mean, -VALUE_LIMIT, VALUE_LIMIT)
    state.scale[at, columns] = np.clip(scale, 0, HIGHEST_SCALE)
    state.multiplier[at, columns] = own.multiplier
    return table_levels(state.scale[at, columns], planes)


def even(rows: np.ndarray) -> slice | np.ndarray:
    """Rows as a slice, if they ascend evenly: a view of them takes no copy."""
    if len(rows) < 2:
        return rows
    step = int(rows[1] - rows[0])
    return slice(int(rows[0]), int(rows[-1]) + 1, step) if step > 0 and (np.diff(rows) == step).all() else rows


def waves(rows: Any, count: int) -> list[Any]:
    """Parts of the rows of a subset, an array or a tensor: each of them doubles how many are known, between those.

    Every 2^(count-1)th, then those in the middle, and so on; half of all rows are in the last part.
    """
    strides = [1 << count - 1 - number for number in range(count)]
    return [rows[:: strides[0]], *(rows[stride :: 2 * stride] for stride in strides[1:])]


def default_order(subsets: int, planes: int) -> tuple[tuple[int, str], ...]:
    """Order (subset, kind) in which refinements of a subset follow the base of the next ones.

    For 4 subsets and one plane, counted from 1: 1b 1f 2b 1v 2f 3b 2v 3f 4b 3v 4f 4v.
    """
    found: list[tuple[int, str]] = []
    for subset in range(subsets):
        found += [(subset, "base")] + ([(subset - 1, "view")] if subset else []) + [(subset, "fine")] * planes
    return (*found, *([(subsets - 1, "view")] if subsets else []))


def check_order(order: Sequence[Packet], planes: int) -> None:
    """Raise BitstreamError unless every subset has one `base`, then `planes` times `fine` and one `view`."""
    seen: dict[int, list[Packet]] = {}
    for packet in order:
        seen.setdefault(packet.subset, []).append(packet)
    if sorted(seen) != list(range(len(seen))):
        raise BitstreamError("the subsets of the order of packets are not counted from 0 on")
    for subset, parts in seen.items():
        kinds = [part.kind for part in parts]
        if kinds[0] != "base" or sorted(kinds) != sorted(["base", *["fine"] * planes, "view"]):
            raise BitstreamError(f"subset {subset} has the packets {', '.join(kinds)[:80]}")
        if len({part.rows for part in parts}) > 1:
            raise BitstreamError(f"the packets of subset {subset} differ in their rows")


def _none(dtype: type) -> np.ndarray:
    return np.empty((0, NUMBERS), dtype)
