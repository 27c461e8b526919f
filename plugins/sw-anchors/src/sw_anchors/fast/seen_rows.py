"""Rows of visible anchors whose number the host may not know yet.

For a view rendered before, the last number serves as an estimate, so the host starts decoding without waiting.
"""

from __future__ import annotations

import torch
from torch import Tensor

MIN_CAPACITY = 256
"""Smallest capacity."""


class AnchorOrder:
    """An order of all anchors.

    rows        [N] int64
    padded      the same, and behind them row 0, [N+1]
    numbers     1, 2, ..., as many as the largest capacity has places
    """

    def __init__(self, rows: Tensor) -> None:
        """Take rows [N] int64."""
        self.padded = torch.cat([rows, rows.new_zeros(1)])
        self.rows = self.padded[:-1]
        self.numbers = torch.arange(1, capacity_of(len(rows)) + 1, device=rows.device)


class SeenRows:
    """Rows of the visible anchors, known to the host.

    loaded      [V] int64: what tensors of `capacity` rows are filled with; V < capacity
    capacity    one of a few sizes, which serve all views
    """

    def __init__(self, rows: Tensor) -> None:
        """Take rows [V] int64."""
        self.loaded, self.capacity = rows, capacity_of(len(rows))

    def write_number(self, to: Tensor) -> None:
        """Write the number of visible rows into a device scalar, without waiting."""
        to.fill_(len(self.loaded))

    def fit(self) -> bool:
        """Whether all visible rows fit the capacity, with one to spare."""
        return True

    def placed(self) -> Tensor:
        """Visible rows within the capacity, [V] int64."""
        return self.loaded

    def known(self) -> Tensor:
        """All visible rows, [V] int64."""
        return self.loaded


class ExpectedRows(SeenRows):
    """SeenRows that the device finds, in as many places as are expected; the host may ask for their number later.

    loaded      [C] int64; places that no anchor takes name row 0. Seen ones beyond C are left out: `number` tells
    capacity    C
    """

    def __init__(self, order: AnchorOrder, seen: Tensor, places: int) -> None:
        """Take the first `places` rows in order that are seen [N] bool; N > 0."""
        self._order, self._seen = order, seen
        taken = seen.cumsum(0)
        self._count = taken[-1]
        # Of each place the first row that brings the number of seen ones there: a scatter may write in any order.
        at = torch.searchsorted(taken, order.numbers[:places])
        self.loaded, self.capacity = order.padded.index_select(0, at), places
        self._on_host, self._copied = self._count, None
        if seen.is_cuda:
            self._on_host = torch.empty((), dtype=torch.int64, pin_memory=True)
            self._on_host.copy_(self._count, non_blocking=True)
            self._copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
            # Of its own device: another may be the current one, whose stream has nothing to do with the copy.
            self._copied.record(torch.cuda.current_stream(seen.device))

    def number(self) -> int:
        """Number of seen rows, perhaps more than there are places. Waits until the device has counted them."""
        if self._copied is not None:
            self._copied.synchronize()
        return int(self._on_host)

    def write_number(self, to: Tensor) -> None:
        to.copy_(self._count)

    def fit(self) -> bool:
        """Whether all visible rows fit, see SeenRows; waits like `number`."""
        return self.number() < self.capacity

    def placed(self) -> Tensor:
        """Visible rows within the capacity, see SeenRows; waits like `number`."""
        return self.loaded[: self.number()]

    def known(self) -> Tensor:
        """All visible rows, see SeenRows; waits for the device."""
        return self._order.rows[self._seen]


def capacity_of(count: int) -> int:
    """Round `count` anchors up to a capacity, four sizes per octave."""
    size = max(count + 1, MIN_CAPACITY)
    unit = 1 << (size.bit_length() - 3)
    return -(-size // unit) * unit
