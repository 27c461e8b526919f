"""Ctrl-C, or what is treated like it, waits for a place where the state is whole, so that what is saved is."""

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
    """While installed, a Ctrl-C waits for the end of the next `with guard.interruptible():`, or of the guard itself.

    Inside such a part it is raised at once, and so is a second one anywhere.
    It is installed in the main thread only, and only over Python's own handler: whoever handles SIGINT in a way of
    their own, or ignores it, goes on doing so. Where that handler was also given to SIGTERM or SIGHUP, those wait too.
    In any other case it does nothing.
    """

    def __init__(self) -> None:
        self._pending = False
        self._open = False
        self._taken: list[int] = []

    def __enter__(self) -> InterruptGuard:
        if threading.current_thread() is threading.main_thread():
            for number in ASKED_TO_END:
                if signal.getsignal(number) is signal.default_int_handler:
                    signal.signal(number, self._handle)
                    self._taken.append(number)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        while self._taken:
            signal.signal(self._taken.pop(), signal.default_int_handler)
        if kind is None:
            self._raise_pending()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        waits = not (self._open or self._pending)
        self._pending = True
        if not waits:
            raise KeyboardInterrupt
        log.warning("interrupted: finishing this step and saving a checkpoint (Ctrl-C again to stop at once)")

    def _raise_pending(self) -> None:
        if self._pending:
            raise KeyboardInterrupt

    @contextmanager
    def interruptible(self) -> Iterator[None]:
        """Mark a part in which the state is whole: an interrupt that comes is raised, one that waited at the end."""
        self._open = True
        try:
            yield
            self._raise_pending()
        finally:
            self._open = False
