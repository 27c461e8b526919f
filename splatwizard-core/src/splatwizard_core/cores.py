"""Number of cores that this process may use."""

from __future__ import annotations

import os


def available_cores() -> int:
    """Those that the scheduler gives to this process."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
