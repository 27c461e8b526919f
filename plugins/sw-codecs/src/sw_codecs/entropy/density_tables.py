"""Columns of integers under densities of their own: the encoder turns each density into counts, and stores these.

Used by `mixture`. A decoder that evaluated the density itself would need exp and tanh,
whose last bits differ between machines, and one wrong count garbles all that follows. The counts of a column cover the
integers in which the density has its mass; what lies outside is escape coded.

Layout (docs/bitstream.md): u8 version, u32 rows, u16 columns, u32 CRC-32 of the matrix (int64, column after column);
if there are rows, for each column the signed varint of the first integer and the varint of how many integers the table
covers; the count tables, the escape last; varint length and the coded entries in chunks as in `columns`; the escapes as
Exp-Golomb bits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, exp_golomb
from sw_codecs.bits.packing import ByteReader, write_signed, write_varint
from sw_codecs.coders.count_tables import pack_tables, rounded_counts, unpack_tables
from sw_codecs.coders.model_spec import Table
from sw_codecs.entropy.column_plan import MAX_TABLE
from sw_codecs.entropy.columns import MAX_ELEMENTS, decode_classes, encode_classes

VERSION = 1
TOTAL = 1 << 20
SIZE_LIMIT = MAX_TABLE - 1  # and the escape
VALUE_LIMIT = 1 << 38  # what Exp-Golomb escapes reach


class Window(NamedTuple):
    """The integers low..high of one column that get a count."""

    low: int
    high: int

    @property
    def size(self) -> int:
        return self.high - self.low + 1


def windows(matrix: np.ndarray, low: np.ndarray, high: np.ndarray) -> list[Window]:
    """For each column of `matrix` [N, C] the part of low..high [C] that occurs, at most 4,095 about the median.

    low, high   float64, where the density of each column ends. Raises ValueError unless low <= high
    """
    if not (low <= high).all():
        raise ValueError("a density has parameters that are not finite")
    found = []
    ends = np.clip([np.floor(low), np.ceil(high)], -VALUE_LIMIT, VALUE_LIMIT)
    for values, least, most in zip(matrix.T, *ends, strict=True):
        middle = int(np.median(values)) if len(values) else 0
        first, last = (int(values.min()), int(values.max())) if len(values) else (0, 0)
        first, last = max(first, int(least)), min(last, int(most))
        if first > last:  # nothing of the column is where its density says
            first = last = min(max(middle, int(least)), int(most))
        if last - first >= SIZE_LIMIT:
            first = min(max(middle - SIZE_LIMIT // 2, first), last - SIZE_LIMIT + 1)
            last = first + SIZE_LIMIT - 1
        found.append(Window(first, last))
    return found


def encode(matrix: np.ndarray, spans: list[Window], mass: Callable[[int, np.ndarray], np.ndarray]) -> bytes:
    """Bytes of int64 [N, C]; mass(column, integers) gives their probabilities, float64."""
    rows, columns = matrix.shape
    if matrix.size and (matrix.min() < -VALUE_LIMIT or matrix.max() > VALUE_LIMIT):
        raise ValueError("a symbol is beyond 2^38")
    crc, head = 0, b""
    tables, entries, signs, magnitudes = [], [], [np.empty(0, bool)], [np.empty(0, np.int64)]
    for column, span in enumerate(spans if rows else []):
        values = np.ascontiguousarray(matrix[:, column])
        crc = checksum.crc32(values.astype("<i8", copy=False), crc)
        outside = (values < span.low) | (values > span.high)
        counts = _counts(mass(column, np.arange(span.low, span.high + 1)), has_escapes=bool(outside.any()))
        entries.append(np.where(outside, span.size, values - span.low))
        escaped = values[outside]
        signs.append(escaped < span.low)
        magnitudes.append(np.where(escaped < span.low, span.low - escaped, escaped - span.high) - 1)
        tables.append(counts)
        head += write_signed(span.low) + write_varint(span.size)
    start = bytes([VERSION]) + rows.to_bytes(4, "little") + columns.to_bytes(2, "little") + crc.to_bytes(4, "little")
    if not rows:
        return start
    chunks = encode_classes(entries, [Table(rounded_counts(t)) for t in tables])
    escapes = exp_golomb.encode(np.concatenate(signs), np.concatenate(magnitudes))
    return b"".join([start, head, pack_tables(tables), write_varint(len(chunks)), chunks, escapes])


def _counts(mass: np.ndarray, *, has_escapes: bool) -> np.ndarray:
    """Counts of the integers and of the escape, int64 [size + 1]."""
    if not (mass >= 0).all():
        raise ValueError("a density has parameters that are not finite")
    escape = max(1, round(TOTAL * max(1 - float(mass.sum()), 0.0))) if has_escapes else 0
    return np.append(np.maximum(np.rint(TOTAL * mass), 1).astype(np.int64), escape)


def decode(data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """int64 of `shape` (N, C) or (N,). Raises BitstreamError for anything `encode` did not write.

    It takes memory for the shape, however short `data` is: hold a shape that comes from a file against `reader.allow`.
    """
    expected = (shape[0], shape[1] if len(shape) > 1 else 1)
    reader = ByteReader(data)
    version, rows, columns, crc = (reader.integer(size) for size in (1, 4, 2, 4))
    if version != VERSION:
        raise BitstreamError(f"density tables of version {version} are not known: upgrade sw-codecs")
    if (rows, columns) != expected or rows * columns > MAX_ELEMENTS:
        raise BitstreamError(f"a matrix of {rows:,} x {columns:,}, expected {expected[0]:,} x {expected[1]:,}")
    matrix, found_crc = np.empty((columns, rows), np.int64), 0
    if rows:
        spans = [_span(reader) for _ in range(columns)]
        tables = unpack_tables(reader, [span.size + 1 for span in spans])
        if not all(counts.any() for counts in tables):
            raise BitstreamError("a count table is empty")
        chunks = ByteReader(bytes(reader.take(reader.varint(reader.left))))
        entries = decode_classes(chunks, rows, [Table(counts) for counts in tables])
        for values, span, found in zip(matrix, spans, entries, strict=True):
            values[:] = found + span.low
        chunks.finish()
        _fill_escapes(matrix, spans, reader.take(reader.left))
        for values in matrix:
            found_crc = checksum.crc32(values.astype("<i8", copy=False), found_crc)
    reader.finish()
    if found_crc != crc:
        raise BitstreamError("the decoded matrix does not match its CRC-32")
    return matrix.T.reshape(shape)


def _span(reader: ByteReader) -> Window:
    low, size = reader.signed(), reader.varint(SIZE_LIMIT)
    if size < 1 or abs(low) > VALUE_LIMIT:
        raise BitstreamError("a column's table covers nothing, or integers out of range")
    return Window(low, low + size - 1)


def _fill_escapes(matrix: np.ndarray, spans: list[Window], bits: memoryview) -> None:
    """Replace the escape entries of matrix [C, N], which lie one above the last integer of their column's table."""
    where = [np.flatnonzero(values == span.high + 1) for values, span in zip(matrix, spans, strict=True)]
    negative, magnitude = exp_golomb.decode(bits, sum(map(len, where)))
    start = 0
    for values, span, rows in zip(matrix, spans, where, strict=True):
        part = slice(start, start + len(rows))
        values[rows] = np.where(negative[part], span.low - 1 - magnitude[part], span.high + 1 + magnitude[part])
        start += len(rows)
