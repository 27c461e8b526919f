"""One writer per run directory."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil

from splatwizard_core.errors import RunLockedError
from splatwizard_native import HeldError, file_lock, read_holder

NAME = ".lock"


@contextlib.contextmanager
def directory_lock(
    directory: Path, *, wait: bool = False, say: Callable[[str], None] = lambda line: None
) -> Iterator[None]:
    """Hold `directory` (made if needed) for this process while the block runs.

    wait    wait for whoever holds it instead of giving up
    say     told in a sentence who is waited for, and if the holder before ended without letting go

    Raises RunLockedError that names the holder, or says why there can be no lock.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path, fact = directory / NAME, f"{directory} is being written by "
    with contextlib.ExitStack() as held:
        try:
            lock = file_lock(path, timeout=-1 if wait else 0, say=lambda holder: say(f"waiting: {fact}{holder}"))
            before = held.enter_context(lock)
        except HeldError as error:
            raise RunLockedError(f"{fact}{error}: wait for it, or choose another directory (--out)") from None
        except OSError as error:  # a file system without locks, a symbolic link in the place of the file
            why = f"{path} cannot be locked ({error.strerror})"
            raise RunLockedError(f"{why}: choose another directory (--out)") from error
        if before is not None:
            say(f"{before} ended without finishing {directory}; going on from what it left")
        yield


def is_held(directory: Path) -> bool:
    """Whether a process of this machine seems to hold a directory. Takes no lock, so nobody is refused meanwhile."""
    holder = read_holder(directory / NAME)
    return holder is not None and holder.host == socket.gethostname() and psutil.pid_exists(holder.pid)
