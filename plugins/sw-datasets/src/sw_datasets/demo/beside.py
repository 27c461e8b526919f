"""Draws in a process of its own: threads that draw wait for each other, since numpy holds the interpreter's lock."""

from __future__ import annotations

import contextlib
import multiprocessing
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import cast

import numpy as np
from numpy.typing import NDArray

from splatwizard_native import available_cores

Draw = Callable[[], NDArray[np.uint8]]

FEWEST_RAYS = 100_000
"""Fewer are drawn sooner than a process begins."""
IGNORED = ("SIGINT", "SIGTERM", "SIGHUP")

_ONE_STARTS = threading.Lock()
"""Else a copy would hold ends of another one's pipe, which then would not tell that either has ended."""


def drawn_beside(draw: Draw, rays: int) -> NDArray[np.uint8]:
    """Return what `draw` does, from a copy of this process where that helps: Linux, more cores than one, many rays.

    A copy that cannot be made or ends early, as where memory is short, leaves it to this process.
    """
    # Elsewhere a copy of a process with threads is unsafe, and one that is itself a helper may have none.
    apart = sys.platform == "linux" and available_cores() > 1 and not multiprocessing.current_process().daemon
    if rays < FEWEST_RAYS or not apart:
        return draw()
    context = multiprocessing.get_context("fork")
    try:
        with _ONE_STARTS:
            here, there = context.Pipe(duplex=False)
            with there:
                child = context.Process(target=_send, args=(here, there, draw))
                child.start()
        try:
            with here:
                return cast("NDArray[np.uint8]", here.recv())
        finally:
            child.join()
    except (EOFError, OSError):
        return draw()


def _send(here: Connection, there: Connection, draw: Draw) -> None:
    for name in IGNORED:  # it is the first process that says that it was interrupted
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    here.close()  # nobody reads on once the first process is gone
    with contextlib.suppress(Exception):  # which says what is wrong when it draws itself
        there.send(draw())
