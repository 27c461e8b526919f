"""Symbols under the shipped count tables, block after block, where each block may depend on those before it.

`gaussian-exact` codes an array whose contexts are all known beforehand; an autoregressive model knows them only for the
next few symbols. One stream:

    u16 table version, u32 CRC-32 of the table file, u32 CRC-32 of all symbols as i32
    varint number of escapes, varint bytes of range-coded words, the words, then the escapes as Exp-Golomb bits

Within a block symbols are coded table by table in ascending number, escapes likewise. Source: specification of the
codec library, exact mode, rules 4 to 6.
"""

from __future__ import annotations

import functools
from typing import Any

import constriction
import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, exp_golomb
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.coders.symbol_stream import guarded
from sw_codecs.entropy.exact_tables import FRACTIONS, Family, exact_tables
from sw_codecs.entropy.gaussian_exact import SYMBOL_LIMIT, _entries, _groups


@functools.cache
def _coding_model(family: str, table: int) -> Any:
    """The library's model of a table; building one takes as long as coding a few hundred symbols."""
    counts = getattr(exact_tables(), family).tables[table].counts
    return constriction.stream.model.Categorical(counts, perfect=False)


def exact_bits(family: str, symbols: np.ndarray, centre: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Bits of each symbol, float64 [n]; arguments as of `ExactWriter.put`."""
    tables: Family = getattr(exact_tables(), family)
    offsets, found = symbols - centre, np.empty(len(symbols))
    for table, rows in _groups(number):
        counts, radius = np.asarray(tables.tables[table].counts), int(tables.radius[table // FRACTIONS])
        entry, outside, escaped = _entries(offsets[rows], radius)
        found[rows] = np.log2(counts.sum() / counts[entry])
        found[rows[outside]] += 2 * (np.floor(np.log2(np.abs(escaped) - radius)) + 1)
    return found


class ExactWriter:
    """family   "gaussian" or "laplace"."""

    def __init__(self, family: str) -> None:
        self._name = family
        self._family: Family = getattr(exact_tables(), family)
        self._coder = constriction.stream.queue.RangeEncoder()
        self._escapes: list[np.ndarray] = []
        self._floors: list[np.ndarray] = []
        self._crc = 0

    def put(self, symbols: np.ndarray, centre: np.ndarray, number: np.ndarray) -> None:
        """Append a block.

        symbols     int64 [n], |s| < 2^30
        centre      int64 [n], integer part of each mean
        number      uint16 [n], table of each symbol: level * 8 + fraction
        """
        if len(symbols) and np.abs(symbols).max() >= SYMBOL_LIMIT:
            raise ValueError("a symbol is beyond 2^30")
        self._crc = checksum.crc32(np.ascontiguousarray(symbols, "<i4"), self._crc)
        offsets = symbols - centre
        for table, rows in _groups(number):
            radius = int(self._family.radius[table // FRACTIONS])
            entry, _, escaped = _entries(offsets[rows], radius)
            with guarded(ValueError, "entropy coding"):
                self._coder.encode(entry.astype(np.int32), _coding_model(self._name, table))
            if len(escaped):
                self._escapes.append(escaped)
                self._floors.append(np.full(len(escaped), radius + 1))

    def finish(self) -> bytes:
        tables = exact_tables()
        head = tables.version.to_bytes(2, "little") + tables.crc.to_bytes(4, "little")
        escaped = np.concatenate([np.empty(0, np.int64), *self._escapes])
        floors = np.concatenate([np.empty(0, np.int64), *self._floors])
        words = self._coder.get_compressed().astype("<u4").tobytes()
        return b"".join([
            head, self._crc.to_bytes(4, "little"), write_varint(len(escaped)), write_varint(len(words)), words,
            exp_golomb.encode(escaped < 0, np.abs(escaped) - floors),
        ])  # fmt: skip


class ExactReader:
    """Reads what an ExactWriter of the same family wrote, block by block with the same centres and tables.

    Raises BitstreamError, as its methods do, for damage and for other tables.
    """

    def __init__(self, family: str, data: bytes) -> None:
        self._name = family
        self._family: Family = getattr(exact_tables(), family)
        reader = ByteReader(data)
        exact_tables().check(reader.integer(2), reader.integer(4))
        self._stored, self._crc = reader.integer(4), 0
        escapes = reader.varint(8 * reader.left)
        words = reader.take(reader.varint(reader.left))
        if len(words) % 4:
            raise BitstreamError(f"{len(words):,} coded bytes are not whole 32-bit words")
        self._negative, self._magnitudes = exp_golomb.decode(reader.take(reader.left), escapes)
        self._used = 0
        with guarded(BitstreamError, "entropy decoding"):
            self._coder = constriction.stream.queue.RangeDecoder(np.frombuffer(words, "<u4").astype(np.uint32))

    def get(self, centre: np.ndarray, number: np.ndarray) -> np.ndarray:
        """The next block, int64 [n]."""
        symbols = np.empty(len(number), np.int64)
        for table, rows in _groups(number):
            radius = int(self._family.radius[table // FRACTIONS])
            with guarded(BitstreamError, "entropy decoding"):
                entry = self._coder.decode(_coding_model(self._name, table), len(rows))
            offsets = np.asarray(entry, np.int64) - radius
            if offsets.max() > radius:
                self._resolve(offsets, radius)
            symbols[rows] = offsets
        symbols += centre
        if len(symbols) and np.abs(symbols).max() >= SYMBOL_LIMIT:
            raise BitstreamError("a symbol is beyond 2^30: damaged data or a wrong context")
        self._crc = checksum.crc32(symbols.astype("<i4"), self._crc)
        return symbols

    def _resolve(self, offsets: np.ndarray, radius: int) -> None:
        """Put the next escapes where the table had no entry, in place."""
        where = np.flatnonzero(offsets > radius)
        part = slice(self._used, self._used + len(where))
        self._used = part.stop
        if self._used > len(self._magnitudes):
            raise BitstreamError("more escapes are coded than stored: damaged data or a wrong context")
        offsets[where] = np.where(self._negative[part], -1, 1) * (self._magnitudes[part] + radius + 1)

    def finish(self) -> None:
        """Raise BitstreamError unless what was read is what was written."""
        if self._used != len(self._magnitudes) or self._crc != self._stored:
            raise BitstreamError("the decoded symbols do not match their CRC-32: damaged data or a wrong context")
