"""CPU time that the threads of this process got, and time for which they waited for a core that others had.

Read from /proc/self/task/*/schedstat (Linux, CONFIG_SCHED_INFO); elsewhere nothing is known and nothing is told.
"""

from __future__ import annotations

import contextlib
import os
import time
from typing import NamedTuple

TASKS = "/proc/self/task"
DISTURBED = 0.1  # threads that wait for a core, on average: times are then up to a tenth longer, or more


class Lap(NamedTuple):
    """One stretch of time, seconds.

    wall        on the clock
    ran         CPU time of all threads that still live
    waited      time for which they were ready to run and had no core
    """

    wall: float
    ran: float
    waited: float

    @property
    def waiting(self) -> float:
        """Mean number of threads that waited for a core. One is enough to hold up all others at the end of a loop."""
        return self.waited / self.wall if self.wall > 0 else 0.0

    @property
    def share(self) -> float:
        """Part of the CPU time that was wanted and was had, 0 to 1."""
        wanted = self.ran + self.waited
        return self.ran / wanted if wanted > 0 else 1.0


class CoreTime:
    """Stop watch of what the scheduler gives to this process."""

    def __init__(self) -> None:
        self._since, self._threads = time.perf_counter(), _threads()

    def lap(self) -> Lap:
        """Return what happened since the last lap, or since this was made."""
        before, since = self._threads, self._since
        self._since, self._threads = time.perf_counter(), _threads()
        nothing = (0, 0)
        ran, waited = (
            sum(now[i] - before.get(thread, nothing)[i] for thread, now in self._threads.items()) / 1e9 for i in (0, 1)
        )
        return Lap(self._since - since, ran, waited)

    def shortage(self) -> float | None:
        """Return the share of the cores that was had in this lap; None if nothing was missing, or nobody knows."""
        lap = self.lap()
        return round(lap.share, 3) if lap.waiting > DISTURBED else None


def _threads() -> dict[str, tuple[int, int]]:
    """Nanoseconds that each thread ran and waited, by its number; empty where the system does not tell."""
    found = {}
    with contextlib.suppress(OSError, ValueError):
        for thread in os.listdir(TASKS):
            with contextlib.suppress(OSError):  # it may have ended
                # Not `open`: that takes three times as long, and asks for the interpreter's lock at each of twice
                # as many calls of the system, while the thread that works wants it.
                file = os.open(f"{TASKS}/{thread}/schedstat", os.O_RDONLY)
                try:
                    ran, waited, _ = map(int, os.read(file, 100).split())
                finally:
                    os.close(file)
                found[thread] = ran, waited
    return found
