"""A lock file that keeps two processes from building the same thing, and that a dead process cannot hold."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from splatwizard_core.errors import NativeBuildError

try:
    import fcntl
except ImportError:  # Windows: builds are not serialised there; the atomic rename of the result keeps them safe.
    fcntl = None  # type: ignore[assignment]

POLL_SECONDS = 0.1


@contextmanager
def build_lock(path: Path, *, timeout: float, say: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock `path`, waiting up to `timeout` seconds for whoever holds it.

    The lock is the kernel's (flock), not the file's existence: it ends with its process, so a file that a
    crashed build left behind blocks nobody. `say` gets one line when there is something to wait for.
    Raises NativeBuildError that names the file and the process if the wait is too long.
    """
    with open(path, "a+", encoding="ascii") as handle:
        waited_since = time.monotonic()
        announced = False
        while not _try_lock(handle.fileno()):
            holder = _holder(path)
            if not announced:
                say(f"waiting for {holder} that is compiling the same kernels ...")
                announced = True
            if time.monotonic() - waited_since > timeout:
                raise NativeBuildError(
                    f"{holder} has held {path} for over {timeout:g} s: end that process, or wait longer with "
                    "SPLATWIZARD_BUILD_TIMEOUT=<seconds>"
                )
            time.sleep(POLL_SECONDS)
        handle.seek(0)
        handle.truncate()
        handle.write(str(os.getpid()))
        handle.flush()
        yield


def _try_lock(descriptor: int) -> bool:
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _holder(path: Path) -> str:
    try:
        return f"process {int(path.read_text(encoding='ascii'))}"
    except (OSError, ValueError):
        return "another process"
