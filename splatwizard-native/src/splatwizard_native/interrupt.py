"""Ctrl-C, or what is treated like it, waits for the end of a training step, so that what is saved is whole."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

log = logging.getLogger(__name__)

# Windows has no terminal that hangs up.
ASKED_TO_END = [n for name in ("SIGINT", "SIGTERM", "SIGHUP") if (n := getattr(signal, name, None)) is not None]


class InterruptGuard:
    """While installed, a Ctrl-C inside `with guard.step():` only sets `pending`; a second one, or one outside, raises.

    It is installed in the main thread only, and only over Python's own handler: whoever handles SIGINT in a way of
    their own, or ignores it, goes on doing so. Where that handler was also given to SIGTERM or SIGHUP, those wait too.
    In any other case it does nothing.
    """

    def __init__(self) -> None:
        self.pending = False
        self._busy = False
        self._taken: list[int] = []

    def __enter__(self) -> InterruptGuard:
        if threading.current_thread() is threading.main_thread():
            for number in ASKED_TO_END:
                if signal.getsignal(number) is signal.default_int_handler:
                    signal.signal(number, self._handle)
                    self._taken.append(number)
        return self

    def __exit__(self, *_: object) -> None:
        while self._taken:
            signal.signal(self._taken.pop(), signal.default_int_handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._busy and not self.pending:
            self.pending = True
            log.warning("interrupted: finishing this step and saving a checkpoint (Ctrl-C again to stop at once)")
            return
        raise KeyboardInterrupt

    @contextmanager
    def step(self) -> Iterator[None]:
        """Mark the part in which an interrupt waits."""
        self._busy = True
        try:
            yield
        finally:
            self._busy = False
