"""One writer per run directory."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from splatwizard_core.errors import RunLockedError

NAME = ".lock"
POLL_SECONDS = 0.5


@contextlib.contextmanager
def directory_lock(
    directory: Path, *, wait: bool = False, on_wait: Callable[[str], None] | None = None
) -> Iterator[None]:
    """Hold `directory` (made if needed) for this process while the block runs.

    wait        wait for whoever holds it instead of giving up
    on_wait     called once with a sentence about the holder before waiting

    The operating system lets go of the lock when its holder ends, however it ends: a lock file that a killed run
    left behind holds nothing. Raises RunLockedError that names process and machine.
    """
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / NAME
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        asked = False
        while True:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                holder = describe_holder(path)
                if not wait:
                    raise RunLockedError(
                        f"{directory} is being written by {holder}: wait for it, or choose another --out"
                    ) from None
                if on_wait is not None and not asked:
                    on_wait(f"waiting for {holder}, which writes {directory}")
                asked = True
                time.sleep(POLL_SECONDS)
        _write_holder(descriptor)
        try:
            yield
        finally:
            # The file stays: removing it would let two processes lock two files of the same name.
            os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def _write_holder(descriptor: int) -> None:
    since = datetime.now(timezone.utc).isoformat(timespec="seconds")
    text = json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since})
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, text.encode(), 0)


def describe_holder(path: Path) -> str:
    """`process 4711 on host since 2026-01-01T12:00:00+00:00`, from the lock file."""
    try:
        holder: Any = json.loads(path.read_text())
        return f"process {holder['pid']} on {holder['host']} since {holder['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"  # it is just beginning or ending
