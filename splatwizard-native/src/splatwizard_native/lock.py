"""Lock files of the operating system, which takes a lock back when its holder ends, however."""

from __future__ import annotations

import contextlib
import json
import os
import shlex
import socket
import sys
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import NamedTuple

from splatwizard_native.errors import ForeseenError, NativeBuildError

POLL_SECONDS = 0.5
COMMAND_CHARACTERS = 200  # of the holder's command that are kept


class Holder(NamedTuple):
    """The process that holds a lock file.

    since   ISO 8601, UTC
    """

    pid: int
    host: str = "?"
    since: str = "?"
    command: str = "?"

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host} since {self.since} (`{self.command}`)"


class HeldError(ForeseenError):
    """Another process holds a lock: the message names it."""


@contextlib.contextmanager
def file_lock(path: Path, *, timeout: float, say: Callable[[str], None]) -> Iterator[Holder | None]:
    """Hold the lock `path` while the block runs; gives the holder that ended without letting go, if one did.

    timeout     seconds to wait for whoever holds it; below 0: for ever
    say         told whom it waits for

    Raises HeldError that names the holder, OSError where there can be no lock.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(path, poll_interval=POLL_SECONDS, fallback_to_soft=False)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(lock.acquire(timeout=0))
        except Timeout:
            holder = str(read_holder(path) or "another process")
            try:
                if timeout:
                    say(holder)
                held.enter_context(lock.acquire(timeout=timeout))
            except Timeout:
                raise HeldError(holder) from None
        before = read_holder(path)
        with contextlib.suppress(OSError):  # a full disk: the lock holds all the same, and reading needs no space
            path.write_text(json.dumps(_myself()._asdict()), encoding="utf-8")
        # The file stays, empty: removing it would let two processes lock two files of the same name.
        held.callback(os.truncate, path, 0)
        yield before


@contextlib.contextmanager
def build_lock(path: Path, *, timeout: float, say: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of a build, waiting up to `timeout` seconds; `say` is told whom for.

    Raises NativeBuildError that names the file and the process if the wait is too long.
    """
    if path.is_symlink() or (path.exists() and not path.is_file()):
        # Locking empties a file, and its holder is written into it: never through a link that another user left.
        raise NativeBuildError(f"{path} is a link or no file, and so no lock: delete it")
    told = "waiting for {} that is compiling the same kernels ..."
    try:
        with file_lock(path, timeout=max(0.0, timeout), say=lambda holder: say(told.format(holder))):
            yield
    except HeldError as error:
        raise NativeBuildError(
            f"{error} has held {path} for over {timeout:g} s: end that process, or wait longer with "
            "SPLATWIZARD_BUILD_TIMEOUT=<seconds>"
        ) from None


def read_holder(path: Path) -> Holder | None:
    """Read the holder that a lock file names; None for nobody, or one that is just beginning or ending."""
    with contextlib.suppress(OSError, ValueError, TypeError):
        found = Holder(**json.loads(path.read_text(encoding="utf-8")))
        return found if isinstance(found.pid, int) else None
    return None


def _myself() -> Holder:
    since = datetime.now(timezone.utc).isoformat(timespec="seconds")
    command = shlex.join([os.path.basename(sys.argv[0]) or "python", *sys.argv[1:]])
    return Holder(os.getpid(), socket.gethostname(), since, command[:COMMAND_CHARACTERS])
