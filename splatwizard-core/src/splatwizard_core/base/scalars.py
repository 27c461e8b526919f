"""Reading losses back from a GPU with as few waits as can be."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def read_scalars(scalars: Sequence[Tensor]) -> list[float]:
    """Return the values of one-element tensors, in order; a GPU among their devices is waited for once."""
    gpu = next((scalar.device for scalar in scalars if scalar.device.type != "cpu"), None)
    if gpu is None:
        return [scalar.item() for scalar in scalars]
    on_gpu = [scalar.detach().reshape(()).to(gpu, torch.float64) for scalar in scalars]
    values: list[float] = torch.stack(on_gpu).tolist()
    return values


class Verdict:
    """Whether some losses are finite, asked for now and answered later: by then a GPU has long said so."""

    def __init__(self, totals: Sequence[Tensor]) -> None:
        """totals: at least one, all on one device."""
        fine = torch.stack([total.detach().reshape(()) for total in totals]).isfinite().all()
        self._event: torch.cuda.Event | None = None
        if fine.is_cuda:
            # Of its own device: another may be the current one, whose stream has nothing to do with the copy.
            stream = torch.cuda.current_stream(fine.device)
            # Into pinned memory, behind what is queued: neither this nor the next steps wait for it.
            fine = fine.to("cpu", non_blocking=True)
            self._event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self._event.record(stream)
        self._fine = fine

    def fine(self) -> bool:
        """Return the answer; waits for it if it is not there yet."""
        if self._event is not None:
            self._event.synchronize()
        return bool(self._fine)
