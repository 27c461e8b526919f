"""rANS streams side by side in numpy: a symbol of each at a time, where no compiled kernel can be had.

Symbols of a stream are coded in their order, each under its own table; escapes are Exp-Golomb bits of the stream.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits import exp_golomb
from sw_codecs.entropy.exact_streams import refuse_damage, share_tables

_U = np.uint64
_FULL = _U(1 << 32)
_MASK = _U((1 << 24) - 1)
PLANE_LIMIT = 1 << 24
MOST_PREFIX = 40


class LaneReader:
    """Streams of `content`, whose table is `sizes` [count, 3]; see `exact_streams.read_sizes`."""

    def __init__(self, family: str, content: memoryview, sizes: np.ndarray) -> None:
        self._shares, self._first, self._radius, bucket = (each.numpy() for each in share_tables(family))
        self._bucket = bucket.reshape(-1)
        data = np.frombuffer(content, np.uint8)
        ends = np.cumsum(sizes[:, 1:].reshape(-1))
        starts = ends - sizes[:, 1:].reshape(-1)
        pieces = [data[a:b] for a, b in zip(starts.tolist(), ends.tolist(), strict=True)]
        words = [each.view("<u4") if len(each) else np.empty(0, "<u4") for each in map(np.copy, pieces[0::2])]
        if any(len(each) and each[-1] == 0 for each in words):
            refuse_damage(1)
        self._words = np.concatenate([np.zeros(1, "<u4"), *words]).astype(np.uint64)
        counts = np.array([len(each) for each in words], np.int64)
        self._begin = np.cumsum(counts) - counts + 1  # in `_words`, whose first is not used
        self._left = counts.copy()
        self._state = np.zeros(len(sizes), np.uint64)
        self._escapes = [_Bits(each) for each in pieces[1::2]]
        everything = np.arange(len(sizes))
        self._refill(everything)
        self._refill(everything)

    def _refill(self, lanes: np.ndarray) -> None:
        state, left = self._state[lanes], self._left[lanes]
        low = (state < _FULL) & (left > 0)
        word = self._words[np.where(low, self._begin[lanes] + left - 1, 0)]
        self._state[lanes] = np.where(low, state << _U(32) | word, state)
        self._left[lanes] = left - low

    def get(
        self, streams: Sequence[int], centres: Sequence[np.ndarray], numbers: Sequence[np.ndarray]
    ) -> list[np.ndarray]:
        """The next symbols of some streams, int64. Raises BitstreamError."""
        found = [np.empty(len(each), np.int64) for each in numbers]
        for i in range(max(map(len, numbers), default=0)):
            rows = [row for row, each in enumerate(numbers) if i < len(each)]
            lanes = np.array([streams[row] for row in rows])
            table = np.array([numbers[row][i] for row in rows], np.int64)
            entry = self._entries(lanes, table)
            radius = self._radius[table].astype(np.int64)
            offset = entry - radius
            for j in np.flatnonzero(offset > radius):
                offset[j] = self._escapes[lanes[j]].beyond(int(radius[j]))
            value = offset + np.array([centres[row][i] for row in rows])
            if np.abs(value).max() >= PLANE_LIMIT:
                refuse_damage(3)
            for row, each in zip(rows, value.tolist(), strict=True):
                found[row][i] = each
        return found

    def _entries(self, lanes: np.ndarray, table: np.ndarray) -> np.ndarray:
        state = self._state[lanes]
        q = (state & _MASK).astype(np.int64)
        at = self._first[table].astype(np.int64)
        entry = self._bucket[table * 256 + (q >> 16)].astype(np.int64)
        while len(behind := np.flatnonzero(self._shares[at + entry + 1] <= q)):
            entry[behind] += 1
        low = self._shares[at + entry].astype(np.int64)
        share = (self._shares[at + entry + 1] - low).astype(np.uint64)
        self._state[lanes] = (state >> _U(24)) * share + (q - low).astype(np.uint64)
        self._refill(lanes)
        return entry

    def finish(self) -> None:
        """Raise BitstreamError unless every stream is used up."""
        if self._left.any() or self._state.any():
            refuse_damage(1)
        for each in self._escapes:
            each.finish()


class _Bits:
    """Escape codes of one stream."""

    def __init__(self, data: np.ndarray) -> None:
        self._bits, self._at = np.unpackbits(data, bitorder="little").tobytes(), 0

    def beyond(self, radius: int) -> int:
        one = self._bits.find(b"\x01", self._at + 1, self._at + 1 + MOST_PREFIX)
        length = one - self._at
        if one < 0 or one + length > len(self._bits):
            refuse_damage(2)
        value = 0
        for bit in self._bits[one : one + length]:
            value = value << 1 | bit
        negative, self._at = self._bits[self._at], one + length
        return -(value + radius) if negative else value + radius

    def finish(self) -> None:
        if len(self._bits) - self._at >= 8 or any(self._bits[self._at :]):
            raise BitstreamError("unknown bits follow the escape codes")


class LaneWriter:
    """Writes what a LaneReader of the same family reads."""

    def __init__(self, family: str) -> None:
        self._shares, self._first, self._radius, _ = (each.numpy() for each in share_tables(family))

    def encode(self, streams: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> tuple[bytes, np.ndarray]:
        """Content and table of streams, each (symbols, integer parts of means, table numbers) [n]."""
        parts, sizes = [], np.zeros((len(streams), 3), np.int64)
        for row, (symbols, centre, number) in zip(sizes, streams, strict=True):
            offset, radius = symbols.astype(np.int64) - centre, self._radius[number].astype(np.int64)
            outside = np.abs(offset) > radius
            at = self._first[number] + np.where(outside, 2 * radius + 1, offset + radius)
            words = self._words(self._shares[at].tolist(), self._shares[at + 1].tolist())
            beyond = offset[outside]
            escapes = exp_golomb.encode(beyond < 0, np.abs(beyond) - radius[outside] - 1)
            parts += [words, escapes]
            row[1:] = len(words), len(escapes)
        return b"".join(parts), sizes

    @staticmethod
    def _words(lows: list[int], highs: list[int]) -> bytes:
        words, state = bytearray(), 0
        for low, high in zip(reversed(lows), reversed(highs), strict=True):
            if state >> 40 >= high - low:
                words += (state & 0xFFFFFFFF).to_bytes(4, "little")
                state >>= 32
            state = (state // (high - low)) << 24 | (low + state % (high - low))
        while state:
            words += (state & 0xFFFFFFFF).to_bytes(4, "little")
            state >>= 32
        return bytes(words)
