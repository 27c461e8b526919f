"""`sw` in a process that must not outlive the one that started it: its standard input ends when that one does.

Else the child of a killed run would go on writing into the directory that the next run holds.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import sys
import threading


def _end_with(descriptor: int) -> None:
    """Wait until nobody holds the other end, then end at once."""
    with contextlib.suppress(OSError):
        while os.read(descriptor, 1024):
            pass
    os._exit(1)


if __name__ == "__main__":
    if (asked := signal.getsignal(signal.SIGINT)) is not signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # until there is something to say: the end, without a traceback
    from splatwizard_core.cli.main import main

    owner = os.dup(0)  # the command itself gets an empty input
    with open(os.devnull) as nowhere:
        os.dup2(nowhere.fileno(), 0)
    if sys.argv[1:] == ["--ahead"]:  # of another step's process: what to do is told on the input, later
        import torch  # noqa: F401

        with open(owner, closefd=False) as told:
            sys.argv[1:] = json.loads(told.readline() or sys.exit(1))
    signal.signal(signal.SIGINT, asked)
    threading.Thread(target=_end_with, args=(owner,), name="owner", daemon=True).start()
    sys.exit(main())
