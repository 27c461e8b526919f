"""Plans of how a column of integers is written: a constant, bins or magnitudes with raw low bits, or a dictionary.

Every scheme turns a value into a class (coded with the column's own count table) and raw low bits. Uniform bins suit
bounded values, magnitude classes long tails, a dictionary few values far apart, and the differences of successive rows
smooth columns. The plan with the smallest estimated size wins.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import (
    ByteReader,
    class_bits,
    class_floor,
    split_classes,
    unzigzag,
    write_signed,
    write_varint,
    zigzag,
)
from sw_codecs.fast.column_costs import costs, histogram, least_bits

CONSTANT, BINS, MAGNITUDES, DICTIONARY = 0, 1, 2, 3
DIFFERENCES = 0x10
MAX_TABLE = 4096
MAX_VALUE = 1 << 60  # the distance of two differences of values then still fits 63 bits


@dataclass(frozen=True)
class ColumnPlan:
    """One column's scheme, everything its decoder needs but the count table itself.

    kind        CONSTANT, BINS, MAGNITUDES or DICTIONARY
    offset      the smallest value; MAGNITUDES: the value whose distance is coded
    parameter   BINS: raw low bits; MAGNITUDES: mantissa bits that belong to the class
    size        length of the count table
    first       None, or the first row's value: then the others are differences to the row above
    gaps        DICTIONARY: steps >= 1 from each distinct value to the next
    """

    kind: int
    offset: int
    parameter: int = 0
    size: int = 0
    first: int | None = None
    gaps: tuple[int, ...] = ()

    def pack(self) -> bytes:
        out = bytes([self.kind | (DIFFERENCES if self.first is not None else 0), self.parameter])
        out += write_signed(self.offset) + write_varint(self.size)
        out += write_signed(self.first) if self.first is not None else b""
        return out + b"".join(write_varint(gap) for gap in self.gaps)

    @classmethod
    def unpack(cls, reader: ByteReader) -> ColumnPlan:
        """Raises BitstreamError for a plan that no encoder makes."""
        kind, parameter = reader.integer(1), reader.integer(1)
        offset, size = reader.signed(), reader.varint(MAX_TABLE)
        first = reader.signed() if kind & DIFFERENCES else None
        steps = size - 1 if kind & ~DIFFERENCES == DICTIONARY else 0
        gaps = tuple(reader.varint(4 * MAX_VALUE) for _ in range(steps))
        plan = cls(kind & ~DIFFERENCES, offset, parameter, size, first, gaps)
        limit = {CONSTANT: 0, BINS: 63, MAGNITUDES: 8, DICTIONARY: 0}.get(plan.kind)
        if limit is None or parameter > limit or (size == 0) != (plan.kind == CONSTANT):
            raise BitstreamError(f"unknown column scheme {kind}/{parameter} with {size} classes")
        if abs(offset) > 2 * MAX_VALUE or (first is not None and abs(first) > MAX_VALUE):
            raise BitstreamError("a column's offset is out of range")
        if gaps and (min(gaps) < 1 or sum(gaps) > 4 * MAX_VALUE):
            raise BitstreamError("a column's dictionary is out of order or out of range")
        if plan.kind == BINS and (size << parameter) > 8 * MAX_VALUE:
            raise BitstreamError("a column's bins leave the 64-bit range")
        if plan.kind == MAGNITUDES and size and int(class_bits(np.array([size - 1]), parameter)[0]) + parameter > 63:
            raise BitstreamError("a column's classes leave the 64-bit range")
        return plan

    def residuals(self, column: np.ndarray) -> np.ndarray:
        """Values to code, int64 [N]: those of the rows, or their differences to the row above."""
        return column if self.first is None else np.diff(column, prepend=self.first)

    def values(self, residuals: np.ndarray) -> np.ndarray:
        """Inverse of `residuals`; overwrites its argument."""
        if self.first is None:
            return residuals
        residuals[:1] += self.first
        return np.cumsum(residuals, out=residuals)

    @property
    def dictionary(self) -> np.ndarray:
        """The distinct values, ascending; int64."""
        return np.cumsum(np.array([self.offset, *self.gaps], np.int64))

    def split(self, residuals: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Classes [N] int64, unsigned codes [N] uint64 whose low bits go raw, and how many (None: `parameter`)."""
        if self.kind == BINS:
            codes = (residuals - self.offset).view(np.uint64)
            return (codes >> np.uint64(self.parameter)).view(np.int64), codes, None
        if self.kind == DICTIONARY:
            return np.searchsorted(self.dictionary, residuals), residuals.view(np.uint64), None
        codes = zigzag(residuals - self.offset)
        classes, extra = split_classes(codes, self.parameter)
        return classes, codes, extra

    def join(self, classes: np.ndarray, raw: np.ndarray) -> np.ndarray:
        """Residuals int64 [N] from classes and raw low bits."""
        if self.kind == BINS:
            codes = (classes.astype(np.uint64) << np.uint64(self.parameter)) | raw
            return codes.view(np.int64) + self.offset
        if self.kind == DICTIONARY:
            return self.dictionary[classes]
        return unzigzag(class_floor(classes, self.parameter) | raw) + self.offset


def _candidates(distinct: np.ndarray, counts: np.ndarray) -> list[ColumnPlan]:
    """Plans that may be the best for several distinct values."""
    low, high = int(distinct[0]), int(distinct[-1])
    shift = max((high - low).bit_length() - 12, 0)  # at most MAX_TABLE bins
    plans = []
    for parameter in range(shift, min(shift + 5, 62)):
        size = ((high - low) >> parameter) + 1
        if size > 1:
            plans.append(ColumnPlan(BINS, low, parameter, size))
    if shift and len(distinct) <= MAX_TABLE:
        plans.append(ColumnPlan(DICTIONARY, low, gaps=tuple(np.diff(distinct).tolist())))
    if len(distinct) > 16:
        median = int(distinct[np.searchsorted(np.cumsum(counts), counts.sum() / 2)])
        plans += [ColumnPlan(MAGNITUDES, median, parameter) for parameter in range(5)]
    return plans


def choose_plan(column: np.ndarray) -> ColumnPlan:
    """The plan with the smallest estimated size for one column of int64 values."""
    if len(column) == 0:
        return ColumnPlan(CONSTANT, 0)
    best, least = ColumnPlan(CONSTANT, int(column[0])), float("inf")
    for first in (None, int(column[0])):
        residuals = replace(best, first=first).residuals(column)
        distinct, counts = histogram(residuals)
        if len(distinct) == 1:
            return ColumnPlan(CONSTANT, int(distinct[0]), first=first)
        if least_bits(counts) < least:
            plans = [replace(plan, first=first) for plan in _candidates(distinct, counts)]
            for plan, bits in costs(plans, distinct, counts):
                if bits < least:
                    best, least = plan, bits
    return best
