"""One writer per run directory: a lock that the operating system takes back when its holder ends, however it ends.

The file names its holder and is touched every few seconds. On one machine the system's lock alone decides. Between
machines it may not: not every network file system shares locks. There a holder that has been silent for a minute and a
half counts as dead, by the clock of the file system.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import shlex
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path

import psutil
from pydantic import BaseModel

from splatwizard_core.errors import RunLockedError

NAME = ".lock"
POLL_SECONDS = 0.5
BEAT_SECONDS = 15.0
SILENT_SECONDS = 90.0
COMMAND_CHARACTERS = 200  # of the holder's command that are kept
ADVICE = "wait for it, or choose another directory (--out)"
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)


class Holder(BaseModel, frozen=True):
    """The process that holds a directory.

    boot    identifies the running kernel: holders of one boot share their locks
    since   ISO 8601, UTC
    """

    pid: int
    host: str = "?"
    boot: str = "?"
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

    Raises RunLockedError that names the holder, or says that the file system has no locks.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / NAME
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        told = False
        while (refused := _try(descriptor, directory, path)) is not None:
            fact, advice = refused
            if not wait:
                raise RunLockedError(f"{fact}: {advice}")
            if not told:
                say(f"waiting: {fact}")
            told = True
            time.sleep(POLL_SECONDS)
        before = read_holder(path)
        if before is not None:
            say(f"{before} ended without finishing {directory}; going on from what it left")
        _write_holder(descriptor)
        ended = threading.Event()
        beats = threading.Thread(target=_beat, args=(descriptor, ended), name="lock", daemon=True)
        beats.start()
        try:
            yield
        finally:
            ended.set()
            beats.join()  # else it could touch whatever gets the number of the descriptor next
            # The file stays: removing it would let two processes lock two files of the same name.
            os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def is_held(directory: Path) -> bool:
    """Whether a process of this machine seems to hold a directory. Takes no lock, so nobody is refused meanwhile."""
    holder = read_holder(directory / NAME)
    return holder is not None and holder.boot == _boot() and psutil.pid_exists(holder.pid)


def _try(descriptor: int, directory: Path, path: Path) -> tuple[str, str] | None:
    """Take the lock; None if it is ours now, else who holds it, and what to do."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return f"{directory} is being written by {read_holder(path) or 'another process'}", ADVICE
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        raise RunLockedError(
            f"{directory} lies on a file system without locks ({error.strerror}): choose a directory on another"
        ) from error
    holder = read_holder(path)
    if holder is None or holder.boot == _boot():
        return None  # nobody, or one whose lock would be in our way if it were alive
    silent = _silence(descriptor)
    if silent >= SILENT_SECONDS:
        return None
    fcntl.flock(descriptor, fcntl.LOCK_UN)
    return (
        f"{directory} belongs to {holder}, on another machine, which gave its last sign of life {silent:.0f} s ago",
        f"if it has ended, try again in {SILENT_SECONDS - silent:.0f} s; else {ADVICE}",
    )


def _silence(descriptor: int) -> float:
    """Return the seconds since the file was last touched, by the clock that touches it."""
    last = os.fstat(descriptor).st_mtime_ns
    os.utime(descriptor)
    now = os.fstat(descriptor).st_mtime_ns
    os.utime(descriptor, ns=(last, last))  # our question is no sign of the holder's life
    return (now - last) / 1e9


def _beat(descriptor: int, ended: threading.Event) -> None:
    while not ended.wait(BEAT_SECONDS):
        with contextlib.suppress(OSError):
            os.utime(descriptor)


def _write_holder(descriptor: int) -> None:
    since = datetime.now(timezone.utc).isoformat(timespec="seconds")
    command = shlex.join(["sw", *sys.argv[1:]])
    if len(command) > COMMAND_CHARACTERS:
        command = f"{command[: COMMAND_CHARACTERS - 3]}..."
    holder = Holder(pid=os.getpid(), host=socket.gethostname(), boot=_boot(), since=since, command=command)
    os.ftruncate(descriptor, 0)
    with contextlib.suppress(OSError):  # a full disk: the lock holds all the same, and reading needs no space
        os.pwrite(descriptor, holder.model_dump_json().encode(), 0)


def read_holder(path: Path) -> Holder | None:
    """Read the holder that a lock file names; None for nobody, or one that is just beginning or ending."""
    with contextlib.suppress(OSError, ValueError):
        return Holder.model_validate_json(path.read_text())
    return None


def _boot() -> str:
    """Return what identifies the running kernel: containers of one machine share it, and so their locks."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    except OSError:
        return socket.gethostname()
