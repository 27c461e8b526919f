"""Memory and clocks of a device: peak memory of the GPU's allocator, or of this process's resident set (`rss`)."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import psutil
import torch

_STATUS = Path("/proc/self/status")
_CLEAR = Path("/proc/self/clear_refs")


def rss_bytes() -> int:
    """Resident set of this process now, bytes."""
    return int(psutil.Process().memory_info().rss)


def peak_rss_bytes() -> int:
    """Largest resident set since the last `reset_peak_rss` (or since the process began), bytes."""
    with suppress(OSError):
        if (found := re.search(r"^VmHWM:\s*(\d+)", _STATUS.read_text(), re.MULTILINE)) is not None:
            return int(found[1]) * 1024
    if sys.platform == "win32":
        return int(psutil.Process().memory_info().peak_wset)
    import resource  # Windows has none

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def reset_peak_rss() -> bool:
    """Let the peak start again from now; False where the system cannot (the peak then is the process's)."""
    with suppress(OSError):
        return bool(_CLEAR.write_text("5"))  # Linux: reset the high-water mark of the resident set
    return False


def synchronize(device: torch.device) -> None:
    """Wait until a GPU has done what it was given; nothing on a CPU."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


class MemoryMeter:
    """Peak memory between `start` and `peak_bytes`, above what was there at `start`.

    kind    "cuda": bytes of torch's allocator, absolute; "rss": growth of the resident set
    """

    def __init__(self, device: torch.device | str) -> None:
        self.device = torch.device(device)
        self.kind: Literal["cuda", "rss"] = "cuda" if self.device.type == "cuda" else "rss"
        self._before = self._peak = self._peak_reserved = 0

    def start(self) -> None:
        self._peak = self._peak_reserved = 0
        self._reset()
        self._before = rss_bytes() if self.kind == "rss" else 0

    def peak_bytes(self) -> int:
        now = torch.cuda.max_memory_allocated(self.device) if self.kind == "cuda" else peak_rss_bytes() - self._before
        return max(self._peak, int(now))

    def current_bytes(self) -> int:
        """Bytes held now, above those at `start` (CUDA: all that is allocated)."""
        now = torch.cuda.memory_allocated(self.device) if self.kind == "cuda" else rss_bytes() - self._before
        return max(int(now), 0)

    def peak_reserved_bytes(self) -> int | None:
        """CUDA: peak of the allocator's reserved pool; None on a CPU."""
        if self.kind != "cuda":
            return None
        return max(self._peak_reserved, int(torch.cuda.max_memory_reserved(self.device)))

    @contextmanager
    def excluded(self) -> Iterator[None]:
        """Leave out of the peak what happens inside: it is kept as it is, and starts again from what is left then.

        Where the system cannot reset a resident set's peak (it can on Linux), everything counts.
        """
        self._peak = self.peak_bytes()
        self._peak_reserved = self.peak_reserved_bytes() or 0
        try:
            yield
        finally:
            self._reset()

    def _reset(self) -> None:
        if self.kind == "cuda":
            synchronize(self.device)
            torch.cuda.reset_peak_memory_stats(self.device)
        else:
            reset_peak_rss()
