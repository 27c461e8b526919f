"""One writer per run directory: a lock of the operating system, which takes it back when its holder ends, however."""

from __future__ import annotations

import contextlib
import os
import shlex
import socket
import sys
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path

import psutil
from filelock import FileLock, Timeout
from pydantic import BaseModel

from splatwizard_core.errors import RunLockedError

NAME = ".lock"
POLL_SECONDS = 0.5
COMMAND_CHARACTERS = 200  # of the holder's command that are kept


class Holder(BaseModel, frozen=True):
    """The process that holds a directory.

    since   ISO 8601, UTC
    """

    pid: int
    host: str = "?"
    since: str = "?"
    command: str = "?"

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host} since {self.since} (`{self.command}`)"


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
    path = directory / NAME
    lock = FileLock(path, poll_interval=POLL_SECONDS, fallback_to_soft=False)
    with contextlib.ExitStack() as held:
        try:
            try:
                held.enter_context(lock.acquire(blocking=False))
            except Timeout:
                fact = f"{directory} is being written by {read_holder(path) or 'another process'}"
                if not wait:
                    raise RunLockedError(f"{fact}: wait for it, or choose another directory (--out)") from None
                say(f"waiting: {fact}")
                held.enter_context(lock.acquire())
        except OSError as error:  # a file system without locks, a symbolic link in the place of the file
            why = f"{path} cannot be locked ({error.strerror})"
            raise RunLockedError(f"{why}: choose another directory (--out)") from error
        before = read_holder(path)
        if before is not None:
            say(f"{before} ended without finishing {directory}; going on from what it left")
        with contextlib.suppress(OSError):  # a full disk: the lock holds all the same, and reading needs no space
            path.write_text(_myself().model_dump_json(), encoding="utf-8")
        # The file stays, empty: removing it would let two processes lock two files of the same name.
        held.callback(os.truncate, path, 0)
        yield


def is_held(directory: Path) -> bool:
    """Whether a process of this machine seems to hold a directory. Takes no lock, so nobody is refused meanwhile."""
    holder = read_holder(directory / NAME)
    return holder is not None and holder.host == socket.gethostname() and psutil.pid_exists(holder.pid)


def read_holder(path: Path) -> Holder | None:
    """Read the holder that a lock file names; None for nobody, or one that is just beginning or ending."""
    with contextlib.suppress(OSError, ValueError):
        return Holder.model_validate_json(path.read_text(encoding="utf-8"))
    return None


def _myself() -> Holder:
    since = datetime.now(timezone.utc).isoformat(timespec="seconds")
    command = shlex.join(["sw", *sys.argv[1:]])
    if len(command) > COMMAND_CHARACTERS:
        command = f"{command[: COMMAND_CHARACTERS - 3]}..."
    return Holder(pid=os.getpid(), host=socket.gethostname(), since=since, command=command)
