"""Symbols of a packet, read by compiled kernels; `sw_wisp.nested` has the same in plain code."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np
import torch

from splatwizard_core.api import BitstreamError
from sw_codecs.entropy.exact_streams import share_tables
from sw_codecs.entropy.exact_tables import FRACTIONS
from sw_codecs.exact_native import EXACT
from sw_codecs.fast.exact_operations import RangeSession
from sw_wisp.nested import CENTRED, UNIT, Reader, Stream

DAMAGE = {
    1: "the words of the octree are damaged",
    3: "the octree has more than the {:,} splats that were announced",
    5: "the octree has fewer than the {:,} splats that were announced",
}
"""Status of the kernel -> what is wrong, with the number of splats."""


class FastReader(Stream):
    """The same as a Reader, by compiled kernels."""

    def __init__(self, data: bytes | memoryview) -> None:
        if len(data) % 4:
            raise BitstreamError(f"{len(data):,} coded bytes are not whole 32-bit words")
        self._is_empty, self._has_read = not len(data), False
        self._coder = RangeSession(torch.from_numpy(np.frombuffer(data, np.uint8).copy()))

    def _get(self, count: int, coded: Callable[[], tuple[torch.Tensor, int]]) -> np.ndarray:
        if not count:
            return np.empty(0, np.int64)
        if self._is_empty:
            raise BitstreamError("symbols are expected, but there are no bytes")
        self._has_read = True
        found, status = coded()
        if status:
            raise BitstreamError("entropy decoding: the words are damaged")
        return found.numpy()

    def bits(self, ones: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        zeros = torch.from_numpy(_shares_of_zero()[ones])
        return self._get(len(ones), lambda: self._coder.bits(zeros)).astype(bool, copy=False)

    def entries(self, tables: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        number = torch.from_numpy(tables.astype(np.int16) * FRACTIONS + CENTRED)
        return self._get(len(tables), lambda: self._coder.entries(share_tables("gaussian"), number))

    def choices(self, counts: np.ndarray, wanted: np.ndarray | None) -> np.ndarray:
        return self._get(len(counts), lambda: self._coder.choices(torch.from_numpy(counts))).astype(np.int64)

    def leaf_octree(self, ones: np.ndarray, rows: int, earlier: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Levels and Morton codes int64 [rows] of a subset. Raises BitstreamError.

        ones        [16 * 185] 4096 times the probabilities of a 1 by level and context
        earlier     for each level the cells of splats of earlier subsets
        """
        if self._is_empty:
            raise BitstreamError("symbols are expected, but there are no bytes")
        self._has_read = True
        known = [np.unique(cells, return_counts=True) for cells in earlier]
        parts = [np.cumsum([0, *(len(cells) for cells, _ in known)]), *map(np.concatenate, zip(*known, strict=True))]
        zeros = torch.from_numpy(_shares_of_zero()[ones])
        levels, codes, status = self._coder.leaf_octree(zeros, rows, [torch.from_numpy(each) for each in parts])
        if status:
            raise BitstreamError(DAMAGE[status].format(rows))
        return levels.numpy(), codes.numpy()

    def finish(self) -> None:
        """Raise BitstreamError if bytes are left that no symbol needs."""
        if not self._is_empty and not (self._has_read and self._coder.is_used_up):
            raise BitstreamError("bytes are left behind the last symbol")


def reader_of(data: bytes | memoryview) -> Reader | FastReader:
    """Decoder that reads the bytes of a packet fastest here. Raises BitstreamError."""
    return FastReader(data) if EXACT.try_load() else Reader(data)


@functools.cache
def _shares_of_zero() -> np.ndarray:
    """Share of 0 int32 [4096], of 2^24, for 4096 times the probability of a 1 (docs/bitstream.md, `Bernoulli`)."""
    return (np.floor((1 - np.arange(UNIT) / UNIT) * ((1 << 24) - 2)) + 1).astype(np.int32)
