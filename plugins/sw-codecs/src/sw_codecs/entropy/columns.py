"""Entropy model `columns`: a matrix of integers, each column with its own stored statistics, range coded.

The work horse for quantized attributes: no context network, nothing to train, bit-exact on every machine since only
integer counts reach the coder. Layout (docs/bitstream.md has it byte by byte):

    u8 version, u32 rows, u16 columns, u32 CRC-32 of the decoded matrix (int64, column after column)
    one plan a column, the count tables, varint length and the coded classes in chunks, the raw low bits
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum
from sw_codecs.bits.packing import ByteReader, class_bits, pack_fixed, packed_size, unpack_fixed, write_varint
from sw_codecs.coders.count_tables import pack_tables, rounded_counts, unpack_tables
from sw_codecs.coders.model_spec import Table
from sw_codecs.coders.symbol_stream import SymbolReader, SymbolWriter
from sw_codecs.entropy.column_plan import CONSTANT, MAGNITUDES, MAX_VALUE, ColumnPlan, choose_plan
from sw_codecs.fast.threads import each_of

VERSION = 1
CHUNK = 1 << 20
MAX_ELEMENTS = 1 << 30


class Columns:
    """Codes [N, C] integers, each |value| <= 2^60, column by column; [N] is taken as one column.

    `context` is the shape for `decode` (the caller knows it from elsewhere: a file is never trusted to say how much
    memory to take) and is not used by `encode` and `bits`.
    """

    def bits(self, symbols: Tensor, context: Any = None) -> Tensor:
        """Bits per element when coded with the statistics of `symbols` itself; no gradient.

        symbols [N, C] or [N] integers; float64 of the same shape, without the tables (about 100 bytes a column).
        """
        matrix = as_matrix(symbols.detach().cpu().numpy())
        found = np.zeros(matrix.shape)
        for c, values in enumerate(matrix.T):
            plan, classes, counts, _ = _planned(values)
            if plan.kind != CONSTANT:
                counts = rounded_counts(counts)
                extra = class_bits(classes, plan.parameter) if plan.kind == MAGNITUDES else plan.parameter
                found[:, c] = np.log2(counts.sum() / counts[classes]) + extra
        return torch.from_numpy(found.reshape(symbols.shape)).to(symbols.device)

    def encode(self, symbols: np.ndarray, context: Any = None) -> bytes:
        """Bytes of `symbols`. Raises ValueError for values beyond 2^60 or more than 2^30 elements."""
        matrix = as_matrix(symbols)
        rows, columns = matrix.shape
        crc = 0
        for values in matrix.T:
            crc = checksum.crc32(np.ascontiguousarray(values, "<i8"), crc)
        found = each_of(_planned, list(matrix.T), rows=rows)
        coded = [each for each in found if each[0].kind != CONSTANT]
        tables = [counts for _, _, counts, _ in coded]
        chunks = encode_classes([each[1] for each in coded], [Table(rounded_counts(counts)) for counts in tables])
        head = bytes([VERSION]) + rows.to_bytes(4, "little") + columns.to_bytes(2, "little") + crc.to_bytes(4, "little")
        plans, raw = (plan.pack() for plan, *_ in found), (low for *_, low in found)
        return b"".join([head, *plans, pack_tables(tables), write_varint(len(chunks)), chunks, *raw])

    def decode(self, data: bytes, context: tuple[int, ...]) -> np.ndarray:
        """int64 of the shape `context`: (N, C) or (N,). Raises BitstreamError for anything `encode` did not write."""
        expected = (context[0], context[1] if len(context) > 1 else 1)
        reader = ByteReader(data)
        version, rows, columns, crc = (reader.integer(size) for size in (1, 4, 2, 4))
        if version != VERSION:
            raise BitstreamError(f"columns of version {version} are not known: upgrade sw-codecs")
        if (rows, columns) != expected or rows * columns > MAX_ELEMENTS:
            raise BitstreamError(f"a matrix of {rows:,} x {columns:,}, expected {expected[0]:,} x {expected[1]:,}")
        plans = [ColumnPlan.unpack(reader) for _ in range(columns)]
        coded = [plan for plan in plans if plan.kind != CONSTANT]
        found = unpack_tables(reader, [plan.size for plan in coded])
        if not all(counts.any() for counts in found):
            raise BitstreamError("a count table is empty")
        tables = [Table(counts) for counts in found]
        chunks = ByteReader(bytes(reader.take(reader.varint(reader.left))))
        matrix = np.empty((columns, rows), np.int64)
        decode_classes(
            chunks, [each for each, plan in zip(matrix, plans, strict=True) if plan.kind != CONSTANT], tables
        )
        found_crc = 0
        for column, plan in zip(matrix, plans, strict=True):
            if plan.kind == CONSTANT:
                column[:] = plan.offset
                plan.values(column)
            else:
                column[:] = plan.values(plan.join(column, _unpack_raw(reader, column, plan)))
            if rows and not -MAX_VALUE <= column.min() <= column.max() <= MAX_VALUE:
                raise BitstreamError("a value is beyond 2^60")
            found_crc = checksum.crc32(column.astype("<i8", copy=False), found_crc)
        chunks.finish()
        reader.finish()
        if found_crc != crc:
            raise BitstreamError("the decoded matrix does not match its CRC-32")
        return matrix.T.reshape(context)


def as_matrix(symbols: np.ndarray) -> np.ndarray:
    """`symbols` as integers [N, C]. Raises ValueError for what `columns` does not take."""
    symbols = np.asarray(symbols)
    if symbols.ndim not in (1, 2) or not np.issubdtype(symbols.dtype, np.integer):
        raise ValueError(f"columns take integers [N, C] or [N], not {symbols.dtype} {list(symbols.shape)}")
    matrix = symbols[:, None] if symbols.ndim == 1 else symbols
    if matrix.size > MAX_ELEMENTS or matrix.shape[0] >= 1 << 32 or matrix.shape[1] >= 1 << 16:
        raise ValueError(f"a matrix of shape {list(matrix.shape)} is too large")
    if matrix.size and (matrix.min() < -MAX_VALUE or matrix.max() > MAX_VALUE):
        raise ValueError("a value is beyond 2^60")
    return matrix


def _planned(values: np.ndarray) -> tuple[ColumnPlan, np.ndarray, np.ndarray, bytes]:
    """The plan of a column, its classes int32 [N], how often each occurs, and raw low bits; a constant has none."""
    column = np.ascontiguousarray(values, np.int64)
    plan = choose_plan(column)
    if plan.kind == CONSTANT:
        return plan, column[:0], column[:0], b""
    classes, codes, extra = plan.split(plan.residuals(column))
    return plan, classes.astype(np.int32), np.bincount(classes), _pack_raw(codes, extra, plan.parameter)


def encode_classes(classes_of: list[np.ndarray], tables: list[Table]) -> bytes:
    """Chunks of at most 2^20 symbols: u32 byte length, u32 CRC-32 of the classes, range-coded words."""

    def encoded(chunk: list[tuple[int, slice]]) -> bytes:
        writer = SymbolWriter()
        for number, rows in chunk:
            writer.put(classes_of[number][rows], tables[number])
        return len(words := writer.finish()).to_bytes(4, "little") + writer.crc.to_bytes(4, "little") + words

    return b"".join(each_of(encoded, _chunks([len(classes) for classes in classes_of])))


def _chunks(counts: list[int]) -> list[list[tuple[int, slice]]]:
    """Pieces of columns with so many rows (number, rows), by the chunk that holds them."""
    found, held = list[list[tuple[int, slice]]](), CHUNK
    for number, rows in enumerate(counts):
        for start in range(0, rows, CHUNK):
            size = min(CHUNK, rows - start)
            if held + size > CHUNK:
                found, held = [*found, []], 0
            found[-1].append((number, slice(start, start + size)))
            held += size
    return found


def decode_classes(chunks: ByteReader, columns: list[np.ndarray], tables: list[Table]) -> None:
    """Fill columns with the classes of their values. Raises BitstreamError for a chunk whose CRC differs."""

    def decode(coded: tuple[list[tuple[int, slice]], int, int, memoryview]) -> None:
        chunk, _, crc, words = coded
        reader = SymbolReader(words)
        for number, rows in chunk:
            columns[number][rows] = reader.get(rows.stop - rows.start, tables[number])
        reader.check(crc)

    parts = _chunks([len(column) for column in columns])
    each_of(decode, [(each, size := chunks.integer(4), chunks.integer(4), chunks.take(size)) for each in parts])


def _pack_raw(codes: np.ndarray, extra: np.ndarray | None, width: int) -> bytes:
    """Raw low bits: all of one width, or for each width 1, 2, ... that occurs the rows that have it."""
    if extra is None:
        return pack_fixed(codes, width)
    widths = np.flatnonzero(np.bincount(extra, minlength=1))
    return b"".join(pack_fixed(codes[extra == w], int(w)) for w in widths if w)


def _unpack_raw(reader: ByteReader, classes: np.ndarray, plan: ColumnPlan) -> np.ndarray:
    """Inverse of `_pack_raw`: uint64 [N]."""
    if plan.kind != MAGNITUDES:
        return unpack_fixed(reader.take(packed_size(len(classes), plan.parameter)), len(classes), plan.parameter)
    extra = class_bits(classes, plan.parameter)
    raw = np.zeros(len(classes), np.uint64)
    for width in np.flatnonzero(np.bincount(extra, minlength=1)):
        if width:
            rows = np.flatnonzero(extra == width)
            raw[rows] = unpack_fixed(reader.take(packed_size(len(rows), int(width))), len(rows), int(width))
    return raw
