"""Anchors that a view sees, in as many places as are expected, so that the host need not wait to learn their number."""

from __future__ import annotations

import torch
from torch import Tensor


class ExpectedRows:
    """Rows of the anchors that are seen, found by the device; the host may ask for their number later.

    rows    [C] int64; places that no anchor takes name row 0. Seen ones beyond C are left out: `number` tells
    count   scalar int64, on the device
    """

    def __init__(self, order: Tensor, seen: Tensor, places: int) -> None:
        """Take the first `places` rows of order [N] int64 that are seen [N] bool; N > 0."""
        self._order, self._seen = order, seen
        taken = seen.cumsum(0)
        self.count = taken[-1]
        # What is not seen, or has no place, is written behind the last one.
        at = (taken - 1).masked_fill_(~seen, places).clamp_(max=places)
        self.rows = order.new_zeros(places + 1).scatter_(0, at, order)[:places]
        self._on_host, self._copied = self.count, None
        if order.is_cuda:
            self._on_host = torch.empty((), dtype=torch.int64, pin_memory=True)
            self._on_host.copy_(self.count, non_blocking=True)
            self._copied = torch.cuda.Event()  # type: ignore[no-untyped-call]
            # Of its own device: another may be the current one, whose stream has nothing to do with the copy.
            self._copied.record(torch.cuda.current_stream(order.device))

    def number(self) -> int:
        """Number of seen rows, perhaps more than there are places. Waits until the device has counted them."""
        if self._copied is not None:
            self._copied.synchronize()
        return int(self._on_host)

    def known(self) -> Tensor:
        """[V] int64: all rows that are seen. Waits for the device."""
        return self._order[self._seen]
