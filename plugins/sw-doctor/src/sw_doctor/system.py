"""Python, memory, cores, and the folders that are written to."""

from __future__ import annotations

import contextlib
import errno
import os
import platform
import shutil
import sys
import tempfile
from pathlib import Path

from splatwizard_core.tooling import Check
from splatwizard_native import available_cores, cache_root
from sw_doctor.text import gigabytes, one_line

GROUP = "system"
OLDEST_PYTHON = (3, 10)
# `sw run --scene demo --rate r3` on a CPU was measured at 0.42 GB resident and 19 MB of files. With room for both:
NEEDED_MEMORY = 0.8e9
NEEDED_DISK = 0.1e9


def check_python() -> Check:
    """Compare the release of Python with the oldest that works."""
    found = f"{platform.python_version()}, {sys.platform}-{platform.machine()}, {sys.prefix}"
    if sys.version_info[:2] < OLDEST_PYTHON:
        return Check(GROUP, "Python", "broken", f"{found}: too old", "install Python 3.10 or newer", needed=True)
    return Check(GROUP, "Python", "ok", found, needed=True)


def check_memory() -> Check:
    """Measure the memory that this process may use: of the machine, or of its container."""
    import psutil

    machine = psutil.virtual_memory()
    limit = container_limit()
    total = min(machine.total, limit or machine.total)
    free = min(machine.available, total)
    facts = {"total_bytes": total, "available_bytes": free}
    found = f"{gigabytes(free)} free of {gigabytes(total)}" + (" (limit of the container)" if limit == total else "")
    if free < NEEDED_MEMORY:
        detail = f"{found}; the demo scene needs {gigabytes(NEEDED_MEMORY)}"
        return Check(GROUP, "memory", "missing", detail, "end other programs, or add memory", True, facts)
    return Check(GROUP, "memory", "ok", found, None, True, facts)


def container_limit() -> int | None:
    """Bytes that the control group of this process grants; None if there is no limit, or none that can be read."""
    for path in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with contextlib.suppress(OSError, ValueError):
            return int(Path(path).read_text())
    return None


def check_cores() -> Check:
    """Count the cores that this process may use."""
    cores = available_cores()
    threads = os.environ.get("OMP_NUM_THREADS")
    said = f", OMP_NUM_THREADS={threads}" if threads else ""
    return Check(GROUP, "cores", "ok", f"{cores}{said}", facts={"cores": cores})


def check_cache() -> Check:
    """Write where compiled kernels go. Without it they cannot be built, and rendering is slow."""
    mend = "point SPLATWIZARD_CACHE to a writable folder: export SPLATWIZARD_CACHE=..."
    return _check_folder("cache folder", cache_root(), mend, False)


def check_working_folder() -> Check:
    """Write where `sw run` writes unless --out says otherwise."""
    return _check_folder("working folder", Path.cwd(), "change to a writable folder, or name one with --out", True)


def _check_folder(name: str, folder: Path, mend: str, needed: bool) -> Check:
    """Write there, and see how much space there is. A folder that is not there yet is tried at its nearest parent."""
    try:
        place = next(p for p in (folder, *folder.absolute().parents) if p.exists())
        # Unbuffered and not empty: a full disk refuses content, not names.
        with tempfile.NamedTemporaryFile(dir=place, prefix=".sw-doctor-", buffering=0) as file:
            file.write(b"\0" * 4096)
        free = shutil.disk_usage(place).free
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return Check(GROUP, name, "missing", f"{folder}: no space left", f"free some space, or {mend}", needed)
        return Check(GROUP, name, "broken", one_line(f"{folder}: {error.strerror or error}"), mend, needed)
    facts = {"path": str(folder), "free_bytes": free}
    if free < NEEDED_DISK:
        detail = f"{folder}: {gigabytes(free)} free, the demo scene needs {gigabytes(NEEDED_DISK)}"
        return Check(GROUP, name, "missing", detail, f"free some space, or {mend}", needed, facts)
    return Check(GROUP, name, "ok", f"{folder}, {gigabytes(free)} free", None, needed, facts)
