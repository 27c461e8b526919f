"""Ctrl-C during a training step waits for the end of the step, so that what is saved is whole."""

from __future__ import annotations

import logging
import signal
import threading
from types import FrameType, TracebackType
from typing import Any

log = logging.getLogger(__name__)


class InterruptGuard:
    """While installed, a Ctrl-C inside `with guard.step():` only sets `pending`; a second one, or one outside, raises.

    It is installed in the main thread only, and only over Python's own handler: whoever handles SIGINT in a way of
    their own goes on doing so. In any other case it does nothing.
    """

    def __init__(self) -> None:
        self.pending = False
        self._busy = False
        self._previous: Any = None

    def __enter__(self) -> InterruptGuard:
        in_main = threading.current_thread() is threading.main_thread()
        if in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._previous is not None:
            signal.signal(signal.SIGINT, self._previous)
            self._previous = None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._busy and not self.pending:
            self.pending = True
            log.warning("interrupted: finishing this step and saving a checkpoint (Ctrl-C again to stop at once)")
            return
        raise KeyboardInterrupt

    def step(self) -> _Busy:
        """Marks the part in which an interrupt waits."""
        return _Busy(self)


class _Busy:
    def __init__(self, guard: InterruptGuard) -> None:
        self._guard = guard

    def __enter__(self) -> None:
        self._guard._busy = True

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._guard._busy = False
