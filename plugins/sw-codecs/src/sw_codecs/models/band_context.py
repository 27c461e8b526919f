"""Higher SH bands with one set of statistics for each class of activity.

A Gaussian whose lower bands are large has large higher bands too, and one that few views saw has none. So rows are
classed by the sum of magnitudes of the bands already coded, in classes of about equal size, and each class is coded
with its own statistics. It is integer arithmetic on decoded symbols; only the number of classes is transmitted.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import BitstreamError, EntropyModel
from sw_codecs.entropy.columns import Columns
from sw_codecs.fast.threads import each_of
from sw_codecs.models.attributes import MAX_SYMBOL
from sw_codecs.models.exchangeable import decoded_matrix

R = TypeVar("R")

MAX_CLASSES = 16
ROWS_PER_CLASS = 2048
"""A class must repay its count tables, about 100 bytes for each of up to 21 columns."""


def suitable_classes(rows: int) -> int:
    """Number of classes that pays for this many Gaussians: a power of two, 1 .. 8."""
    count = 1
    while count < 8 and rows >= 2 * count * ROWS_PER_CLASS:
        count *= 2
    return count


def activity_classes(lower: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """Class 0 .. count - 1 of each row of the symbols [N,C] of lower bands, by the sum of magnitudes."""
    activity = np.zeros(len(lower), np.int64)
    for column in lower.T:  # one at a time: the whole matrix in 64 bits would be the largest thing in memory
        activity += np.abs(column)
    return equal_classes(activity, count)


def equal_classes(values: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Class 0 .. count - 1 of each of `values` [N], in classes of about equal size."""
    ordered = np.sort(values)
    limits = ordered[[len(ordered) * i // count for i in range(1, count)]] if len(ordered) else ordered
    return np.searchsorted(limits, values, side="right")


def encode_band(columns: EntropyModel, classes: Sequence[NDArray[np.int32]]) -> bytes:
    """u32 byte length of each class, then the classes; an empty class has no bytes.

    columns     the entropy model for integer matrices
    classes     symbols [n,C] of the rows of each
    """
    parts = _each(columns, lambda rows: columns.encode(rows, None) if len(rows) else b"", classes)
    return struct.pack(f"<{len(parts)}I", *map(len, parts)) + b"".join(parts)


def decode_matrix(columns: EntropyModel, data: bytes, rows: int, width: int) -> NDArray[np.int64]:
    """Symbols [rows,width], each within +-2^30. Raises BitstreamError."""
    symbols: NDArray[np.int64] = decoded_matrix(columns, data, rows, width)
    if symbols.size and not -MAX_SYMBOL <= int(symbols.min()) <= int(symbols.max()) <= MAX_SYMBOL:
        raise BitstreamError("a quantised value is beyond 2^30")
    return symbols


def decode_band(
    columns: EntropyModel, data: bytes, classes: NDArray[np.int64], count: int, width: int
) -> NDArray[np.int32]:
    """Symbols [N,width]. Raises BitstreamError."""
    start = 4 * count
    if len(data) < start:
        raise BitstreamError(f"{len(data)} bytes cannot hold the lengths of {count} classes")
    lengths = struct.unpack_from(f"<{count}I", data)
    if start + sum(lengths) != len(data):
        raise BitstreamError(f"{len(data):,} bytes, the class lengths say {start + sum(lengths):,}")
    symbols = np.empty((len(classes), width), dtype=np.int32)

    def decode(part: tuple[int, bytes]) -> None:
        k, coded = part
        rows = np.flatnonzero(classes == k)
        if (len(rows) == 0) != (len(coded) == 0):
            raise BitstreamError(f"class {k} has {len(rows):,} rows, but {len(coded):,} bytes")
        if len(rows):
            symbols[rows] = decode_matrix(columns, coded, len(rows), width)

    ends = np.cumsum((start, *lengths)).tolist()
    _each(columns, decode, [(k, data[ends[k] : ends[k + 1]]) for k in range(count)], len(classes) // count)
    return symbols


def _each(columns: EntropyModel, work: Callable[[Any], R], parts: Sequence[Any], rows: int | None = None) -> list[R]:
    """Results of the work on each class, by several threads where the entropy model is known to allow it.

    rows    of a class, about; None: the parts tell
    """
    if not isinstance(columns, Columns):
        return [work(part) for part in parts]
    return each_of(work, parts, rows=max(map(len, parts), default=0) if rows is None else rows)
