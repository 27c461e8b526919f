"""`sw` in a process that must not outlive the one that started it: its standard input ends when that one does.

Else the child of a killed run would go on writing into the directory that the next run holds.
"""

from __future__ import annotations

import json
import os
import sys
import threading

from splatwizard_core.cli.main import main


def _end_with(descriptor: int) -> None:
    """Wait until nobody holds the other end, then end at once."""
    try:
        while os.read(descriptor, 1024):
            pass
    except OSError:
        pass
    os._exit(1)


if __name__ == "__main__":
    owner = os.dup(0)  # the command itself gets an empty input
    nowhere = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nowhere, 0)
    os.close(nowhere)
    if sys.argv[1:] == ["--ahead"]:  # of another step's process: what to do is told on the input, later
        import torch  # noqa: F401

        with open(owner, closefd=False) as told:
            sys.argv[1:] = json.loads(told.readline() or sys.exit(1))
    threading.Thread(target=_end_with, args=(owner,), name="owner", daemon=True).start()
    sys.exit(main())
