"""Seconds and memory of the stages of one compression."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import psutil
import torch
from sw_gaussians import heap

from sw_rasterizers import memory


@dataclass
class Stages:
    """Seconds by name of the stage, summed where it comes again."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextlib.contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Count the time of a block."""
        began = time.perf_counter()
        try:
            yield
        finally:
            give_back()
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began

    def rounded(self) -> dict[str, float]:
        """Seconds to the millisecond, and their sum as `total`."""
        found = {name: round(value, 3) for name, value in self.seconds.items()}
        return {**found, "total": round(sum(self.seconds.values()), 3)}


def give_back() -> None:
    """Return free memory to the system, where the rasterizer or the C library hold on to it."""
    memory.give_back()
    heap.trim()


def peak_bytes(device: torch.device) -> int:
    """Largest memory so far: of a GPU what torch allocated on it, else the resident set of the process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    found = psutil.Process().memory_info()
    return int(getattr(found, "peak_wset", 0)) or _peak_resident() or int(found.rss)


def _peak_resident() -> int:
    """Peak of the resident set, bytes; 0 where the system does not tell it."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line.split()[1] for line in lines if line.startswith("VmHWM")))
    return 0
