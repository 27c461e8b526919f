"""Work on columns and streams by the cores of this machine: numpy and the coders work outside of Python's lock."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from splatwizard_native import available_cores

T = TypeVar("T")
R = TypeVar("R")

MOST = 8
"""Threads at once: each has the arrays of its part in memory."""
FEWEST = 1 << 13
"""Rows of a part from which on threads pay."""


def each_of(work: Callable[[T], R], parts: Sequence[T], *, rows: int = FEWEST) -> list[R]:
    """Results of the work on each part, in their order.

    rows    of a part
    """
    threads = min(MOST, available_cores(), len(parts)) if rows >= FEWEST else 1
    if threads < 2:
        return [work(part) for part in parts]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, parts))
