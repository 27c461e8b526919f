"""Number of cores that this process may use."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path

CGROUPS = Path("/sys/fs/cgroup")


def available_cores() -> int:
    """Return the cores that this process may use, by its affinity and the quotas of its control groups, at least 1."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cgroup_quota()
    return cores if quota is None else max(1, min(cores, math.ceil(quota)))


def cgroup_quota(membership: Path = Path("/proc/self/cgroup"), root: Path = CGROUPS) -> float | None:
    """Return the CPU time per second that the control groups of a process leave it; None: as much as there is.

    membership  lines `ID:CONTROLLERS:PATH`; version 2 has no controllers in it, version 1 has `cpu`
    root        where the hierarchies are mounted; a container often sees its own group there, whatever the path says
    """
    quotas: list[float] = []
    with contextlib.suppress(OSError):
        for line in membership.read_text().splitlines():
            _, controllers, path = line.split(":", 2)
            if controllers == "" or "cpu" in controllers.split(","):
                for group in _upward(root if controllers == "" else root / "cpu", path):
                    quotas += _quota(group)
    return min(quotas, default=None)


def _upward(mount: Path, path: str) -> Iterator[Path]:
    """Yield the folder of a group, then those of the groups that hold it: the tightest quota counts."""
    parts = path.strip("/").split("/")
    for count in range(len(parts), -1, -1):
        yield mount.joinpath(*parts[:count])


def _quota(group: Path) -> list[float]:
    """Return the quota of one group, in a list that is empty if it has none."""
    with contextlib.suppress(OSError, ValueError, ZeroDivisionError):
        if (group / "cpu.max").exists():
            quota, period = (group / "cpu.max").read_text().split()
        else:
            quota, period = ((group / f"cpu.cfs_{what}_us").read_text() for what in ("quota", "period"))
        if quota != "max" and int(quota) > 0:
            return [int(quota) / int(period)]
    return []
