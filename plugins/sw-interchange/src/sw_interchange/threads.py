"""Work on many rows, by two threads where it pays: numpy and the compressors work outside of Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

THREADS = 2
ROWS_AT_ONCE = 1 << 15
"""Rows of a part: its arrays stay in the processor's cache."""


def each_of(work: Callable[[T], R], parts: Sequence[T]) -> list[R]:
    """Results of the work on each part, in their order."""
    if len(parts) < 2:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(work, parts))


def rows_of(count: int) -> list[slice]:
    """Parts that cover `count` rows."""
    return [slice(at, min(at + ROWS_AT_ONCE, count)) for at in range(0, count, ROWS_AT_ONCE)]
