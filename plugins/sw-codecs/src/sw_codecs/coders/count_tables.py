"""Histograms in a file: counts rounded to three bits after the leading one, differences coded under one meta table.

A count c below 16 is kept; above, its top four bits are. The code distance is 0.0005 bit per symbol at worst, and a
table of 256 counts takes about 100 bytes instead of 512.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader, class_floor, split_classes, unzigzag, write_varint, zigzag
from sw_codecs.coders.model_spec import Table
from sw_codecs.coders.symbol_stream import SymbolReader, SymbolWriter

MANTISSA = 3
MAX_CODE = 239  # the code of 2^32 - 1
MAX_META = 2 * MAX_CODE + 1


def count_codes(counts: np.ndarray) -> np.ndarray:
    """Codes 0..239 of counts below 2^32; a positive count never becomes zero."""
    counts = np.asarray(counts, np.uint64)
    extra = split_classes(counts, MANTISSA)[1].astype(np.uint64)
    nearest = counts + ((np.uint64(1) << extra) >> np.uint64(1))
    return split_classes(np.minimum(nearest, np.uint64(2**32 - 1)), MANTISSA)[0]


def code_counts(codes: np.ndarray) -> np.ndarray:
    """The counts that stand for `codes`; int64. What both sides code with."""
    return class_floor(codes, MANTISSA).astype(np.int64)


def rounded_counts(counts: np.ndarray) -> np.ndarray:
    """Counts as they are after storing, int64."""
    return code_counts(count_codes(counts))


def pack_tables(tables: Sequence[np.ndarray]) -> bytes:
    """Store several count tables; the reader must know their lengths.

    The meta counts, varint length, range-coded differences, u32 CRC-32 of them.
    """
    codes = [count_codes(t) for t in tables]
    if not sum(len(c) for c in codes):
        return b""
    differences = np.concatenate([np.diff(c, prepend=0) for c in codes if len(c)])
    symbols = zigzag(differences).astype(np.int64)
    meta = count_codes(np.bincount(symbols))
    writer = SymbolWriter()
    writer.put(symbols, Table(code_counts(meta)))
    coded = writer.finish()
    return b"".join(
        [
            _pack_meta(meta),
            write_varint(len(coded)),
            coded,
            writer.crc.to_bytes(4, "little"),
        ]
    )


def unpack_tables(reader: ByteReader, sizes: Sequence[int]) -> list[np.ndarray]:
    """The tables of the given lengths, int64, as `rounded_counts`. Raises BitstreamError."""
    total = sum(sizes)
    if not total:
        return [np.empty(0, np.int64) for _ in sizes]
    meta = _unpack_meta(reader)
    coded = reader.take(reader.varint(reader.left))
    symbols = SymbolReader(coded)
    differences = symbols.get(total, Table(code_counts(meta)))
    symbols.check(reader.integer(4))
    tables = []
    for part in np.split(unzigzag(differences.astype(np.uint64)), np.cumsum(sizes)[:-1]):
        codes = np.cumsum(part)
        if len(codes) and (codes.min() < 0 or codes.max() > MAX_CODE):
            raise BitstreamError("a stored count is out of range")
        tables.append(code_counts(codes))
    return tables


def _pack_meta(meta: np.ndarray) -> bytes:
    """varint 2 M, then a byte of count code for each of M entries; or, if shorter, varint 2 U + 1, then for each of the
    U entries in use the varint of how many unused ones precede it, and its byte.
    """
    used = np.flatnonzero(meta)
    dense = write_varint(2 * len(meta)) + meta.astype(np.uint8).tobytes()
    sparse = write_varint(2 * len(used) + 1)
    for gap, code in zip(np.diff(used, prepend=-1) - 1, meta[used], strict=True):
        sparse += write_varint(int(gap)) + bytes([int(code)])
    return min(dense, sparse, key=len)


def _unpack_meta(reader: ByteReader) -> np.ndarray:
    count = reader.varint(2 * MAX_META + 1)
    if count % 2 == 0:
        meta = np.frombuffer(reader.take(count // 2), np.uint8)
    else:
        meta, position = np.zeros(MAX_META, np.uint8), -1
        for _ in range(count // 2):
            position += reader.varint(MAX_META) + 1
            if position >= MAX_META:
                raise BitstreamError("the table of tables is too long")
            meta[position] = reader.integer(1)
        meta = meta[: position + 1]  # the length of a table is part of its model
    if not meta.any() or meta.max() > MAX_CODE:
        raise BitstreamError("the table of tables is empty or out of range")
    return meta


def table_bits(codes: np.ndarray) -> float:
    """Roughly what a table costs in the file: used for choosing, never for reporting."""
    return float(step_bits(np.abs(np.diff(codes, prepend=0))).sum())


def step_bits(steps: np.ndarray) -> np.ndarray:
    """The same of each step >= 0 from one code to the next."""
    return np.where(steps == 0, 1.0, 2.5 + np.log2(1 + steps))
