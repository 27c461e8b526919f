"""Work on columns and streams by the cores of this machine: numpy and the coders work outside of Python's lock."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from splatwizard_native import available_cores

T = TypeVar("T")
R = TypeVar("R")

MOST = 8
"""Threads at once: each has the arrays of its part in memory."""
FEWEST = 1 << 13
"""Rows of a part from which on threads pay."""

_this = threading.local()


def each_of(work: Callable[[T], R], parts: Sequence[T], *, rows: int = FEWEST) -> list[R]:
    """Results of the work on each part, in their order.

    rows    of a part

    Work that asks for threads itself gets none: its caller has them.
    """
    return list(each_in_turn(work, parts, rows=rows, ahead=len(parts)))


def each_in_turn(
    work: Callable[[T], R], parts: Sequence[T], *, rows: int = FEWEST, ahead: int = 0
) -> Iterator[R]:  # fmt: skip
    """As `each_of`, one after the other: no more of them than there are threads, or `ahead`, wait to be taken."""
    threads = 1 if rows < FEWEST or getattr(_this, "works", False) else min(MOST, available_cores(), len(parts))
    if threads < 2:
        yield from map(work, parts)
        return
    with ThreadPoolExecutor(threads, initializer=setattr, initargs=(_this, "works", True)) as pool:
        waiting = deque[Future[R]]()
        for part in parts:
            if len(waiting) >= max(threads, ahead):
                yield waiting.popleft().result()
            waiting.append(pool.submit(work, part))
        while waiting:
            yield waiting.popleft().result()
