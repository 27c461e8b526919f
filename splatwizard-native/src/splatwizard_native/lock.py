"""A lock file that keeps two processes from building the same thing, and that a dead process cannot hold."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from splatwizard_native.errors import NativeBuildError


@contextmanager
def build_lock(path: Path, *, timeout: float, say: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock `path`, waiting up to `timeout` seconds for whoever holds it.

    The lock is the kernel's (flock), not the file's existence: it ends with its process, so a file that a
    crashed build left behind blocks nobody. `say` gets one line when there is something to wait for.
    Raises NativeBuildError that names the file and the process if the wait is too long.
    """
    from filelock import FileLock, Timeout

    if path.is_symlink() or (path.exists() and not path.is_file()):
        # Locking empties a file, and the number is written into it: never through a link that another user left.
        raise NativeBuildError(f"{path} is a link or no file, and so no lock: delete it")
    lock = FileLock(path)
    try:
        held = lock.acquire(timeout=0)
    except Timeout:
        say(f"waiting for {_holder(path)} that is compiling the same kernels ...")
        try:
            held = lock.acquire(timeout=max(0.0, timeout))
        except Timeout:
            raise NativeBuildError(
                f"{_holder(path)} has held {path} for over {timeout:g} s: end that process, or wait longer with "
                "SPLATWIZARD_BUILD_TIMEOUT=<seconds>"
            ) from None
    with held:
        path.write_text(str(os.getpid()), encoding="ascii")
        yield


def _holder(path: Path) -> str:
    try:
        return f"process {int(path.read_text(encoding='ascii'))}"
    except (OSError, ValueError):
        return "another process"
