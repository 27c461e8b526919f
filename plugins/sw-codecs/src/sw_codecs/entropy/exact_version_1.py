"""Version 1 of what the exact mode wrote, to be read only: a single range-coded stream for all that depends on it.

`gaussian-exact` had chunks of 2^20 symbols. Planes under spatial models were one stream:

    u16 table version, u32 CRC-32 of the table file, u32 CRC-32 of all symbols as i32
    varint number of escapes, varint bytes of range-coded words, the words, then the escapes as Exp-Golomb bits

Within a block (or chunk) symbols are coded table by table in ascending number, escapes likewise. Source: specification
of the codec library, exact mode, rules 4 to 6.
"""

from __future__ import annotations

import constriction
import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import checksum, exp_golomb
from sw_codecs.bits.packing import ByteReader
from sw_codecs.coders.arithmetic import CHUNK, HEADER
from sw_codecs.coders.model_spec import Table, unchecked
from sw_codecs.coders.symbol_stream import SymbolReader, guarded
from sw_codecs.entropy.exact_streams import SYMBOL_LIMIT, coding_model, groups
from sw_codecs.entropy.exact_tables import FRACTIONS, Family, exact_tables


def decode_chunks(reader: ByteReader, centre: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Symbols int32 [n] of `gaussian-exact`, behind version and CRC-32 of the tables. Raises BitstreamError."""
    family, found = exact_tables().gaussian, np.empty(len(centre), np.int32)
    for start in range(0, len(found), CHUNK):
        part = slice(start, start + CHUNK)
        count, kmin, kmax, length, crc = HEADER.unpack(reader.take(HEADER.size))
        if count != len(found[part]):
            raise BitstreamError(f"a chunk has {count:,} symbols, expected {len(found[part]):,}")
        chunk = _decode_chunk(reader.take(length), number[part], family) + centre[part]
        if chunk.min() != kmin or chunk.max() != kmax or checksum.crc32(chunk.astype("<i4")) != crc:
            raise BitstreamError("the decoded symbols do not match their CRC-32: damaged data or a wrong context")
        found[part] = chunk
    reader.finish()
    return found


def _decode_chunk(payload: bytes | memoryview, number: np.ndarray, family: Family) -> np.ndarray:
    """Offsets from the integer part of the mean, int64 [n]."""
    reader = ByteReader(payload)
    coded = SymbolReader(reader.take(reader.varint(reader.left)))
    offsets, escapes, floors = np.empty(len(number), np.int64), [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for table, rows in groups(number):
        radius = int(family.radius[table // FRACTIONS])
        entry = coded.get_unchecked(len(rows), unchecked(Table, counts=family.counts[table])).astype(np.int64)
        offsets[rows] = entry - radius
        escaped = rows[entry == 2 * radius + 1]
        escapes.append(escaped)
        floors.append(np.full(len(escaped), radius + 1))
    where, floor = np.concatenate(escapes), np.concatenate(floors)
    negative, magnitude = exp_golomb.decode(reader.take(reader.left), len(where))
    if len(where) and (magnitude.max() >= 2 * SYMBOL_LIMIT):
        raise BitstreamError("an escaped symbol is beyond 2^30")
    offsets[where] = np.where(negative, -1, 1) * (magnitude + floor)
    return offsets


class ExactReader:
    """Reads planes of version 1 block by block, with the centres and tables of the encoder.

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
        for table, rows in groups(number):
            radius = int(self._family.radius[table // FRACTIONS])
            with guarded(BitstreamError, "entropy decoding"):
                entry = self._coder.decode(coding_model(self._name, table), len(rows))
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
