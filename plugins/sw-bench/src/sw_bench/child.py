"""One process of a sweep: `sw` with the words that it is given.

    python -m sw_bench.child [DIRECTORY...] -- WORDS...

Its standard input ends when the process that started it does, however that ends: then it does what Ctrl-C does, so a
training writes a checkpoint first, and no process is left that holds directories or cores of the next sweep. It begins
once nobody holds the directories any more: one that a killed sweep left may still be writing its checkpoint.
"""

from __future__ import annotations

import os
import runpy
import signal
import sys
import threading
import time
from pathlib import Path

PATIENCE_SECONDS = 60.0  # from the request to end to the end of the process
LOCK = ".lock"


def main(arguments: list[str]) -> None:
    """Run `sw` with what follows `--`."""
    split = arguments.index("--")
    owner = os.dup(0)  # the command itself gets an empty input
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, 0)
    os.close(nowhere)
    for name in ("SIGUSR1", "SIGUSR2"):  # a batch system warns whole groups with them: the owner will say what to do
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(owner,), name="owner", daemon=True).start()
    _wait_for_those_before([Path(each) for each in arguments[:split]])
    sys.argv = ["sw", *arguments[split + 1 :]]
    runpy.run_module("splatwizard_core", run_name="__main__", alter_sys=True)


def _end_with(descriptor: int) -> None:
    """Wait until nobody holds the other end, then end as with Ctrl-C; after a while, at once."""
    try:
        while os.read(descriptor, 1024):
            pass
    except OSError:
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(PATIENCE_SECONDS)
    os._exit(1)


def _wait_for_those_before(directories: list[Path]) -> None:
    held = [directory for directory in directories if (directory / LOCK).exists()]
    if held:
        from splatwizard_core.tooling import directory_lock, say

        for directory in held:
            with directory_lock(directory, wait=True, say=say):
                pass


if __name__ == "__main__":
    main(sys.argv[1:])
