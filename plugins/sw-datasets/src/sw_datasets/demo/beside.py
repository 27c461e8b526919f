"""Draws in a process of its own: threads that draw wait for each other, since numpy holds the interpreter's lock."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import cast

import numpy as np
from numpy.typing import NDArray

from splatwizard_native import available_cores

Draw = Callable[[], NDArray[np.uint8]]

FEWEST_RAYS = 100_000
"""Fewer are drawn sooner than a process begins."""


def drawn_beside(draw: Draw, rays: int) -> NDArray[np.uint8]:
    """Return what `draw` does, from a copy of this process where that helps: Linux, more cores than one, many rays.

    A copy that ends early, as where memory is short, leaves it to this process.
    """
    # Elsewhere a copy of a process with threads is unsafe, and one that is itself a helper may have none.
    apart = sys.platform == "linux" and available_cores() > 1 and not multiprocessing.current_process().daemon
    if rays < FEWEST_RAYS or not apart:
        return draw()
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    try:
        with there:
            child = context.Process(target=_send, args=(there, draw))
            child.start()
        try:
            return cast("NDArray[np.uint8]", here.recv())
        except EOFError:
            return draw()
        finally:
            child.join()
    finally:
        here.close()


def _send(to: Connection, draw: Draw) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is the first process that says that it was interrupted
    to.send(draw())
