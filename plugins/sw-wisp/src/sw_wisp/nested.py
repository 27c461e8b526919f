"""Entropy model `nested-gaussian`: indices under centred Gaussian tables, whole or as coarse index and refinements.

The index k of a number counts its steps from the predicted mean, k = round((z - mu) / Q). It is coded under the shipped
table of its scale level (fraction 0, exact_tables), or coarsely: c = round(k / 3) under the table of a third of the
scale, later the trit t = k - 3c under the three counts of T[3c-1], T[3c], T[3c+1]. Cells nest because 3 is odd.

All symbols of a packet share one range coder. Indices of a block are coded table by table, ascending; those outside
their table's window -R..R take its escape entry, and after the last table come, pass by pass over all of them in row
order and as equiprobable bits, their signs, whether |k| - R has more than 1, 2, ... bits, and its bits behind the
leading one, highest first.
"""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Iterator

import constriction
import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import bit_length
from sw_codecs.coders.symbol_stream import guarded
from sw_codecs.entropy.exact_streams import coding_model
from sw_codecs.entropy.exact_tables import FRACTIONS, LEVELS, exact_tables

CENTRED = FRACTIONS // 2  # tables whose mean is a whole number of steps
INDEX_LIMIT = 1 << 21
"""Indices stay within this: 2^21 steps of at least Q0 / 64 are more than any kept range has."""
UNIT = 4096
THIRD_OF_SCALE = 39624
"""Scale levels, with 12 fractional bits, by which a scale sinks when its step triples: 4096 x 63 ln 3 / ln 1280."""
EVEN = UNIT // 2
_models = constriction.stream.model


def table_levels(scales: np.ndarray, planes: int = 0) -> np.ndarray:
    """Table 0..63 (uint8) for scale levels int64 with 12 fractional bits; `planes`: how often the step was tripled."""
    return np.clip((scales - planes * THIRD_OF_SCALE + UNIT // 2) >> 12, 0, LEVELS - 1).astype(np.uint8)


def coarser(indices: np.ndarray) -> np.ndarray:
    """Coarse index round(k / 3) of each index."""
    return (indices + 1) // 3


class Stream(ABC):
    """Symbols of one packet, written, read or counted; `wanted` is None where they are read.

    Every method returns the symbols, so that one walk through a packet serves the encoder and the decoder.
    """

    @abstractmethod
    def bits(self, ones: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        """Bits bool [n]; `ones` [n] in 1..4095 are 4096 times their probabilities of being 1."""

    @abstractmethod
    def entries(self, tables: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        """Entries int64 [n], 0..2R + 1 each, of tables uint8 [n]: table by table."""

    @abstractmethod
    def choices(self, counts: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        """One of three, int64 [n] in 0..2, under counts float64 [n, 3]."""

    def indices(self, tables: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        """Indices int64 of the shape of `tables` (uint8 0..63), row after row. Raises BitstreamError for damage."""
        flat, shape = tables.reshape(-1), tables.shape
        given = None if wanted is None else np.asarray(wanted, np.int64).reshape(-1)
        if given is not None and np.abs(given).max(initial=0) >= INDEX_LIMIT:
            raise ValueError(f"an index of {np.abs(given).max():,} is beyond {INDEX_LIMIT:,} steps")
        radius = exact_tables().gaussian.radius[flat]
        entry = None if given is None else np.where(np.abs(given) > radius, 2 * radius + 1, given + radius)
        entry = self.entries(flat, entry)
        found, outside = entry - radius, entry > 2 * radius
        escaped = np.flatnonzero(outside)
        if len(escaped):
            found[escaped] = self._escapes(radius[escaped], None if given is None else given[escaped])
        return found.reshape(shape)

    def _escapes(self, radius: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        """Indices int64 [m] beyond `radius`: sign, then |k| - radius >= 1 by its length and digits."""
        even = functools.partial(np.full, fill_value=EVEN)
        magnitude = None if wanted is None else np.abs(wanted) - radius
        length = None if magnitude is None else bit_length(magnitude)
        negative = self.bits(even(len(radius)), None if wanted is None else wanted < 0)
        digits, active = np.ones(len(radius), np.int64), np.arange(len(radius))
        while len(active):
            size = int(digits[active[0]])
            longer = self.bits(even(len(active)), None if length is None else length[active] > size)
            active = active[longer]
            digits[active] += 1
            if len(active) and size >= INDEX_LIMIT.bit_length():
                raise BitstreamError("an escape code is damaged")
        value = np.ones(len(radius), np.int64)
        for place in range(1, int(digits.max())):
            rows = np.flatnonzero(digits > place)
            shift = digits[rows] - 1 - place
            bit = self.bits(even(len(rows)), None if magnitude is None else (magnitude[rows] >> shift) & 1 == 1)
            value[rows] = value[rows] << 1 | bit
        value = np.where(negative, -1, 1) * (value + radius)
        if np.abs(value).max() >= INDEX_LIMIT:
            raise BitstreamError(f"an index is beyond {INDEX_LIMIT:,} steps")
        return value

    def trits(self, tables: np.ndarray, coarse: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        """Refinements -1, 0, 1 (int64) of coarse indices int64, under tables (uint8) of the finer step."""
        counts = trit_counts(tables.reshape(-1), coarse.reshape(-1))
        given = None if wanted is None else np.asarray(wanted, np.int64).reshape(-1) + 1
        return (self.choices(counts, given) - 1).reshape(coarse.shape)


class Writer(Stream):
    """Codes the symbols of a packet into bytes."""

    def __init__(self) -> None:
        self._coder = constriction.stream.queue.RangeEncoder()
        self._is_empty = True

    def _put(self, symbols: np.ndarray, model: object, *parameters: np.ndarray) -> np.ndarray:
        if len(symbols):
            self._is_empty = False
            with guarded(ValueError, "entropy coding"):
                self._coder.encode(np.ascontiguousarray(symbols, np.int32), model, *parameters)
        return symbols

    def bits(self, ones: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        assert wanted is not None
        return self._put(wanted, _models.Bernoulli(perfect=False), ones / UNIT)

    def entries(self, tables: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        assert wanted is not None
        for level, rows in _by_table(tables):
            self._put(wanted[rows], _table(level))
        return wanted

    def choices(self, counts: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        assert wanted is not None
        return self._put(wanted, _models.Categorical(perfect=False), counts)

    def finish(self) -> bytes:
        """The bytes, whole 32-bit words; none for no symbols."""
        if self._is_empty:
            return b""
        words = self._coder.get_compressed()
        return bytes(words.astype("<u4", copy=False).tobytes())


class Reader(Stream):
    """Decodes what a Writer wrote, asked for in the same order.

    Damaged bytes give other symbols, seldom an error: the CRC-32 of the section tells. Raises BitstreamError.
    """

    def __init__(self, data: bytes | memoryview) -> None:
        if len(data) % 4:
            raise BitstreamError(f"{len(data):,} coded bytes are not whole 32-bit words")
        words = np.frombuffer(data, "<u4").astype(np.uint32)
        self._is_empty, self._has_read = not len(words), False
        with guarded(BitstreamError, "entropy decoding"):
            self._coder = constriction.stream.queue.RangeDecoder(words)

    def _get(self, count: int, model: object, *parameters: np.ndarray) -> np.ndarray:
        if not count:
            return np.empty(0, np.int64)
        if self._is_empty:
            raise BitstreamError("symbols are expected, but there are no bytes")
        self._has_read = True
        with guarded(BitstreamError, "entropy decoding"):
            found = self._coder.decode(model, *parameters) if parameters else self._coder.decode(model, count)
        return np.asarray(found, np.int64)

    def bits(self, ones: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        return self._get(len(ones), _models.Bernoulli(perfect=False), ones / UNIT) == 1

    def entries(self, tables: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        found = np.empty(len(tables), np.int64)
        for level, rows in _by_table(tables):
            found[rows] = self._get(len(rows), _table(level))
        return found

    def choices(self, counts: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        return self._get(len(counts), _models.Categorical(perfect=False), counts)

    def finish(self) -> None:
        """Raise BitstreamError if bytes are left that no symbol needs."""
        if (not self._is_empty and not self._has_read) or not self._coder.maybe_exhausted():
            raise BitstreamError("bytes are left behind the last symbol")


class Counter(Stream):
    """Adds up the bits that a Writer would need, within 1e-4 of them: `total`."""

    def __init__(self) -> None:
        self.total = 0.0

    def bits(self, ones: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        assert wanted is not None
        self.total += float(-np.log2(np.where(wanted, ones, UNIT - ones) / UNIT).sum())
        return wanted

    def entries(self, tables: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        assert wanted is not None
        for level, rows in _by_table(tables):
            counts = exact_tables().gaussian.counts[level * FRACTIONS + CENTRED]
            self.total += float(-np.log2(counts[wanted[rows]] / counts.sum()).sum())
        return wanted

    def choices(self, counts: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        assert wanted is not None
        taken = np.take_along_axis(counts, wanted[:, None], axis=1)[:, 0]
        self.total += float(-np.log2(taken / counts.sum(1)).sum())
        return wanted


def index_bits(tables: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Bits float64 of each index under its table (uint8 0..63), escapes included; broadcasts."""
    bits, middle = _bits_by_offset()
    radius = exact_tables().gaussian.radius[tables]
    indices = np.asarray(indices, np.int64)
    beyond = np.maximum(np.abs(indices) - radius, 0)
    escape = np.where(beyond > 0, 2.0 * bit_length(beyond), 0.0)  # a sign, and 2 length - 1 bits
    return bits[tables, np.clip(indices, -radius - 1, radius + 1) + middle] + escape


def trit_counts(tables: np.ndarray, coarse: np.ndarray) -> np.ndarray:
    """Counts float64 [n, 3] of the trits -1, 0, 1 of coarse indices [n]; 1 beyond the window of the table."""
    flat, first = _flat_counts()
    radius = exact_tables().gaussian.radius[tables]
    fine = 3 * coarse[:, None] + np.arange(-1, 2)  # [n, 3]
    inside = np.abs(fine) <= radius[:, None]
    place = first[tables][:, None] + np.where(inside, fine + radius[:, None], 0)
    return np.where(inside, flat[place], 1.0)


def _by_table(tables: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Each table that occurs, ascending, with its rows."""
    order = np.argsort(tables, kind="stable")  # radix sort of bytes
    ends = np.cumsum(np.bincount(tables, minlength=LEVELS))
    starts = np.concatenate([[0], ends[:-1]])
    for level in np.flatnonzero(ends > starts).tolist():
        yield level, order[starts[level] : ends[level]]


def _table(level: int) -> object:
    return coding_model("gaussian", level * FRACTIONS + CENTRED)


@functools.cache
def _flat_counts() -> tuple[np.ndarray, np.ndarray]:
    """Counts of the centred tables one after another, and where each begins [64]."""
    tables = [exact_tables().gaussian.counts[level * FRACTIONS + CENTRED] for level in range(LEVELS)]
    return np.concatenate(tables), np.cumsum([0, *(len(each) for each in tables[:-1])])


@functools.cache
def _bits_by_offset() -> tuple[np.ndarray, int]:
    """Bits [64, 2 middle + 1] of each index from -middle to middle; beyond the window those of the escape entry."""
    radius = exact_tables().gaussian.radius
    middle = int(radius.max()) + 1
    bits = np.empty((LEVELS, 2 * middle + 1))
    for level, window in enumerate(radius.tolist()):
        counts = exact_tables().gaussian.counts[level * FRACTIONS + CENTRED]
        own = -np.log2(counts / counts.sum())
        bits[level] = own[-1]
        bits[level, middle - window : middle + window + 1] = own[:-1]
    return bits, middle
