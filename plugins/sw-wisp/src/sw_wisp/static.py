"""Context `none`: each number is a Gaussian that its column and the splat's level alone decide, stored in the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader
from sw_codecs.entropy.exact_tables import LEVELS as TABLES
from sw_wisp.nested import UNIT, index_bits
from sw_wisp.numbers import HIGHEST_LEVEL, LOWEST_LEVEL, NUMBERS
from sw_wisp.packets import Prediction, State

MEAN_UNIT = 16
"""Means are stored in 1/256 of a base step: int16, 1/4096 times this."""
ENOUGH = 64
"""Splats of a level that get statistics of their own; fewer take those of the nearest level that has."""


@dataclass(frozen=True)
class StaticContext:
    """Statistics by level and column.

    row         [16] int64: which row serves levels 3..18
    means       [R,22] int64, multiples of 16, in base steps with 12 fractional bits
    tables      [R,22] int64 0..63
    multipliers [22] int64 64..8192: a column's step is base step * multiplier / 4096
    """

    row: np.ndarray
    means: np.ndarray
    tables: np.ndarray
    multipliers: np.ndarray

    kind = "none"
    waves = (1, 1)

    @classmethod
    def fitted(
        cls, levels: np.ndarray, units: np.ndarray, multipliers: Sequence[int] = (UNIT,) * NUMBERS
    ) -> StaticContext:
        """The statistics that code splats in the fewest bits.

        levels  [N] int64
        units   [N,22] float64 values in base steps times 4096
        """
        counts = np.bincount(levels - LOWEST_LEVEL, minlength=HIGHEST_LEVEL - LOWEST_LEVEL + 1)
        own = np.flatnonzero(counts >= ENOUGH)
        own = own if len(own) else np.array([int(counts.argmax())])
        row = np.abs(np.arange(len(counts))[:, None] - own).argmin(1)
        steps = np.asarray(multipliers, np.int64)
        means, tables = np.zeros((len(own), NUMBERS), np.int64), np.zeros((len(own), NUMBERS), np.int64)
        for number in range(len(own)):
            part = units[row[levels - LOWEST_LEVEL] == number]
            if not len(part):
                continue
            means[number] = np.clip(np.rint(part.mean(0) / MEAN_UNIT), -32767, 32767).astype(np.int64) * MEAN_UNIT
            for column in range(NUMBERS):
                k = np.rint((part[:, column] - means[number, column]) / steps[column]).astype(np.int64)
                distinct, times = np.unique(k, return_counts=True)
                bits = index_bits(np.arange(TABLES)[:, None], distinct) @ times
                tables[number, column] = bits.argmin()
        return cls(row, means, tables, steps)

    def start(self) -> None:
        """Forget nothing."""

    def predict(self, block: slice, rows: np.ndarray, state: State) -> Prediction:
        """Distributions of the columns `block` of splats `rows`."""
        at = self.row[state.levels[rows] - LOWEST_LEVEL]
        means = self.means[at, block]
        return Prediction(means, self.tables[at, block] * UNIT, np.broadcast_to(self.multipliers[block], means.shape))

    def moved(self, part: slice, rows: np.ndarray, state: State) -> None:
        """Nothing: columns are independent."""

    def changed(self, rows: np.ndarray, columns: slice, before: np.ndarray | None, state: State) -> None:
        """Learn nothing from splats that were decoded."""

    def pack(self) -> bytes:
        """Rows in use, the row of each level, multipliers, means, tables."""
        return b"".join(
            [
                bytes([len(self.means), *self.row.tolist()]),
                self.multipliers.astype("<u2").tobytes(),
                (self.means // MEAN_UNIT).astype("<i2").tobytes(),
                self.tables.astype(np.uint8).tobytes(),
            ]
        )

    @classmethod
    def unpack(cls, reader: ByteReader) -> StaticContext:
        """Inverse of `pack`. Raises BitstreamError."""
        rows = reader.integer(1)
        row = np.frombuffer(reader.take(HIGHEST_LEVEL - LOWEST_LEVEL + 1), np.uint8).astype(np.int64)
        multipliers = np.frombuffer(reader.take(2 * NUMBERS), "<u2").astype(np.int64)
        means = np.frombuffer(reader.take(2 * NUMBERS * rows), "<i2").astype(np.int64) * MEAN_UNIT
        tables = np.frombuffer(reader.take(NUMBERS * rows), np.uint8).astype(np.int64)
        if row.max() >= rows or tables.max(initial=0) >= TABLES:
            raise BitstreamError("statistics of a level are not there")
        if multipliers.min() < 64 or multipliers.max() > 2 * UNIT:
            raise BitstreamError("a step multiplier leaves 64..8192")
        return cls(row, means.reshape(rows, NUMBERS), tables.reshape(rows, NUMBERS), multipliers)
