"""Reading losses back from a GPU with as few waits as can be."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def read_scalars(scalars: Sequence[Tensor]) -> list[float]:
    """Return the values of one-element tensors, in order; each GPU among their devices is waited for once."""
    found = [0.0] * len(scalars)
    elsewhere: dict[torch.device, list[int]] = {}
    for i, scalar in enumerate(scalars):
        if scalar.device.type == "cpu":
            found[i] = scalar.item()
        else:
            elsewhere.setdefault(scalar.device, []).append(i)
    for at in elsewhere.values():
        values = torch.stack([scalars[i].detach().reshape(()).double() for i in at]).tolist()
        for i, value in zip(at, values, strict=True):
            found[i] = value
    return found


class Verdict:
    """Whether some losses are finite, asked for now and answered later: by then a GPU has long said so."""

    def __init__(self, totals: Sequence[Tensor]) -> None:
        """totals: at least one, all on one device."""
        fine = torch.stack([total.detach().reshape(()) for total in totals]).isfinite().all()
        self._event: torch.cuda.Event | None = None
        if fine.is_cuda:
            # Into pinned memory, behind what is queued: neither this nor the next steps wait for it.
            fine = fine.to("cpu", non_blocking=True)
            self._event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._event.record()
        self._fine = fine

    def fine(self) -> bool:
        """Return the answer; waits for it if it is not there yet."""
        if self._event is not None:
            self._event.synchronize()
        return bool(self._fine)
