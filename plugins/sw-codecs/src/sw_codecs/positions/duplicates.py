"""Points that occur more than once: the position codecs code the set of points, and apart how often each occurs."""

from __future__ import annotations

import numpy as np

from splatwizard_core.api import BitstreamError
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.entropy.columns import Columns


def without_duplicates(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct codes, and how many more points each of them stands for."""
    is_first = np.diff(codes, prepend=-1) != 0
    starts = np.flatnonzero(is_first)
    return codes[is_first], np.diff(starts, append=len(codes)) - 1


def encode_duplicates(extra: np.ndarray) -> bytes:
    """varint number of duplicated points; if any, varint length and a `columns` matrix of index steps and counts."""
    places = np.flatnonzero(extra)
    if not len(places):
        return write_varint(0)
    body = Columns().encode(np.stack([np.diff(places, prepend=0), extra[places]], 1))
    return write_varint(len(places)) + write_varint(len(body)) + body


def decode_duplicates(reader: ByteReader, count: int, distinct: int) -> np.ndarray:
    """Times that each distinct point occurs; int64 [distinct], sums to `count`."""
    times = np.ones(distinct, np.int64)
    places = reader.varint(distinct)
    if places:
        steps, extra = Columns().decode(bytes(reader.take(reader.varint(reader.left))), (places, 2)).T
        index = np.cumsum(steps)
        if steps[0] < 0 or (steps[1:] <= 0).any() or index[-1] >= distinct or index.min() < 0:
            raise BitstreamError("the indices of duplicated points are out of range")
        if extra.min() <= 0 or extra.max() > count:
            raise BitstreamError("the number of duplicates is out of range")
        times[index] += extra
    if times.sum() != count:
        raise BitstreamError(f"{times.sum():,} points with duplicates, {count:,} were announced")
    return times
