"""Row-wise evaluation in parts of bounded size, so that widths claimed by a file cannot exhaust memory.

A block of symbols has at most 2^20 numbers, so a narrow block has many rows. The context per row may have thousands of
numbers if a header says so, and only the network's outputs are as narrow as the block.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

MAX_EXACT_NUMBERS = 1 << 20  # most context numbers per part in mode `exact`; results do not depend on it
MAX_FLOAT_NUMBERS = 1 << 24
"""The same in mode `float`, where results may depend on it: contexts up to 800 numbers per row are never split."""


def parts_of(rows: Tensor, width: int, numbers: int) -> tuple[Tensor, ...]:
    """Split `rows` into parts of at most numbers // width rows; `width`: intermediate numbers per row."""
    return rows.split(max(1, numbers // width))


def by_parts(evaluate: Callable[[Tensor], Tensor], rows: Tensor, width: int, numbers: int) -> Tensor:
    """Return `evaluate(rows)` of a row-wise function, computed numbers // width rows at a time.

    rows        [n, ...]
    width       largest count of numbers per row inside `evaluate`
    """
    parts = iter(parts_of(rows, width, numbers))
    first = evaluate(next(parts))
    if len(first) == len(rows):
        return first
    # Written in place: kept one by one, the results would lie between the temporaries and hold their memory.
    found, start = first.new_empty(len(rows), *first.shape[1:]), len(first)
    found[:start] = first
    for part in parts:
        found[start : start + len(part)] = evaluate(part)
        start += len(part)
    return found
