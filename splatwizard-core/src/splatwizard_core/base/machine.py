"""The machine that a time was measured on, as plain values: no name of it, no path, no user."""

from __future__ import annotations

import contextlib
import platform
import sys
from pathlib import Path
from typing import Any

import torch

from splatwizard_native import available_cores


def describe_machine(device: torch.device) -> dict[str, Any]:
    """Return Python, platform, processor, cores, threads and the GPU, if `device` is one (else "gpu" is None)."""
    found: dict[str, Any] = {
        "python": platform.python_version(),
        "platform": f"{sys.platform}-{platform.machine()}",
        "device": str(device),
        "cpu": _cpu_name(),
        "cores": available_cores(),
        "threads": torch.get_num_threads(),
        "gpu": None,
    }
    if device.type == "cuda":
        properties = torch.cuda.get_device_properties(device)
        found["gpu"] = {
            "name": properties.name,
            "memory_bytes": properties.total_memory,
            "compute_capability": f"{properties.major}.{properties.minor}",
            "cuda": torch.version.cuda,
            "driver": _driver(),
            "clock_mhz": _clock(device),
        }
    return found


def _cpu_name() -> str:
    """Return the model name of the processor as the system tells it."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return platform.processor() or platform.machine()


def _clock(device: torch.device) -> int | None:
    """Return the SM clock now, MHz; None where the packages that read it are not installed."""
    try:
        return int(torch.cuda.clock_rate(device))
    except (ImportError, RuntimeError, OSError):
        return None


def _driver() -> str | None:
    try:
        first = Path("/proc/driver/nvidia/version").read_text().splitlines()[0]
    except (OSError, IndexError):
        return None
    return next((word for word in first.split() if word.count(".") >= 1 and word[0].isdigit()), None)
