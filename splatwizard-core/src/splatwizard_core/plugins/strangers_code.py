"""Guard around a stranger's code: what it prints, how it ends, how long it takes, what it leaves changed.

Each is told in one line with the distribution. Code of ours runs without it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Iterator
from typing import Any

from splatwizard_core.errors import PluginError
from splatwizard_core.plugins.process_state import kept_endings, kept_state

log = logging.getLogger(__name__)

PATIENCE, AGAIN = 3.0, 0.25
"""Seconds that registering may take (milliseconds are usual), and until what could not be stopped then is stopped."""
LATE = "_SW_LATE"  # variable with those that took too long: processes that are started wait for none of them again
CALLERS = ("splatwizard_core.plugins.manager", "splatwizard_core.plugins.guards")
STREAMS = {"stdin": 0, "stdout": 1, "stderr": 2, "__stdin__": 0, "__stdout__": 1, "__stderr__": 2}


class ProcessExit(SystemExit):
    """Somebody calls os._exit."""

    def __str__(self) -> str:
        return f"os._exit({self.code})"


class TooLongError(BaseException):
    """Registering takes too long; no `except Exception` of a stranger's holds it up."""


_told: set[str] = set()


@contextlib.contextmanager
def strangers_code(whose: str, *, registering: str = "", imports: bool = False, prints: bool = False) -> Iterator[None]:
    """Let a block of a stranger's code touch nothing but itself.

    whose           how messages name it, "metric 'sharp' of sw-theirs 0.2"
    registering     top-level module of a plugin that is imported, or whose hook adds entries: then random numbers and
                    threads are told too, and it may take no longer than PATIENCE
    imports         a target is imported: it is told after PATIENCE
    prints          stdout is its own

    What it raises comes out, os._exit as ProcessExit, and what is no Exception and was not asked for from outside (a
    KeyboardInterrupt of its own) as RuntimeError.
    """

    def tell(what: str) -> None:
        if (line := f"{whose} {what}") not in _told:  # a metric may do so at every view
            _told.add(line)
            log.warning("%s", line)

    def changes(what: str) -> None:
        tell(f"changes {what}: it is put back")

    if registering and whose in os.environ.get(LATE, "").split("\n"):
        raise PluginError(f"registering took more than {PATIENCE:.0f} s in the command that started this one")
    with contextlib.ExitStack() as stack:
        stack.enter_context(_kept_streams(tell, looks=bool(registering), prints=prints))
        stack.enter_context(kept_state(changes, tells_seeds=bool(registering)))
        came = stack.enter_context(kept_endings(changes))
        stack.enter_context(exits_are_raised())
        if registering:
            stack.enter_context(_threads_that_end(tell))
        if registering or imports:
            stack.enter_context(_limited(tell, registering))
        try:
            yield
        except TooLongError as error:
            os.environ[LATE] = "\n".join([whose, *filter(None, [os.environ.get(LATE)])])
            late = f"registering takes more than {PATIENCE:.0f} s, and every command would wait for it"
            raise PluginError(late) from error
        except BaseException as error:
            if came or isinstance(error, (Exception, SystemExit)):
                raise
            raise RuntimeError(" ".join(f"it raises {type(error).__name__} {error}".split())) from error


class _Lent:
    """Stands for a standard stream; closing it closes nothing, and is noted in `closed`."""

    def __init__(self, stream: Any, number: int, closed: set[int]) -> None:
        self._stream, self._number, self._closed = stream, number, closed

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def close(self) -> None:
        self._closed.add(self._number)

    detach = close


@contextlib.contextmanager
def _kept_streams(tell: Any, *, looks: bool, prints: bool) -> Iterator[None]:
    """Let stdout be stderr, file descriptor 1 too, and open again what is closed.

    looks   tell who writes to the descriptor
    prints  let stdout be stdout
    """
    streams, closed = {name: getattr(sys, name) for name in STREAMS}, set[int]()
    with contextlib.suppress(OSError, ValueError, AttributeError):
        sys.stdout.flush()  # what stands in it is ours
    kept = {}
    for number in (0, 1, 2):
        with contextlib.suppress(OSError):
            kept[number] = os.dup(number)
    with tempfile.TemporaryFile() if looks else contextlib.nullcontext() as held:
        if not prints and kept.keys() >= {1, 2}:
            os.dup2(kept[2] if held is None else held.fileno(), 1)
        for name, number in STREAMS.items():
            stream = streams["stderr" if number == 1 and not prints else name]
            setattr(sys, name, _Lent(stream, number, closed))
        try:
            yield
        finally:
            for name, stream in streams.items():
                setattr(sys, name, stream)
            for number, copy in kept.items():
                try:
                    os.fstat(number)
                except OSError:
                    closed.add(number)
                os.dup2(copy, number)
                os.close(copy)
            if closed:
                names = (("input", "output", "error")[number] for number in sorted(closed))
                tell(f"closes standard {' and '.join(names)}: it stays open")
            if held is not None and (held.seek(0), written := held.read(1 << 16))[1]:
                tell("writes to file descriptor 1; here it stands on stderr:")
                with contextlib.suppress(OSError):
                    os.write(2, written.rstrip(b"\n") + b"\n")


@contextlib.contextmanager
def exits_are_raised() -> Iterator[None]:
    """In the block `os._exit` raises ProcessExit, in this thread of this process.

    Else a step of a run could end without its result, and with the status of one that has it.
    """
    outer, here = os._exit, (os.getpid(), threading.get_ident())

    def leave(status: int = 0) -> None:
        if (os.getpid(), threading.get_ident()) != here:
            outer(status)  # a child that it forked
        raise ProcessExit(status)

    os._exit = leave  # type: ignore[assignment]
    try:
        yield
    finally:
        os._exit = outer


@contextlib.contextmanager
def _threads_that_end(tell: Any) -> Iterator[None]:
    """Threads that are started end with the process, which would wait for them else; they are told."""
    start: Any = threading.Thread.start

    def start_daemon(thread: threading.Thread) -> None:
        thread.daemon = True
        tell(f"starts a thread ({thread.name:.60}) when it is registered: that ends with the command")
        start(thread)

    threading.Thread.start = start_daemon  # type: ignore[assignment, method-assign]
    try:
        yield
    finally:
        threading.Thread.start = start  # type: ignore[method-assign]


@contextlib.contextmanager
def _limited(tell: Any, package: str) -> Iterator[None]:
    """Raise TooLongError in a block that imports `package` and takes longer than PATIENCE; "": it is only told.

    So while it imports another package: half an import of torch would take torch from everybody.
    """
    if not hasattr(signal, "setitimer") or threading.current_thread() is not threading.main_thread():
        yield
        return

    def look(_number: int, frame: Any) -> None:
        tell(f"is being imported for {PATIENCE:.0f} s")
        stops = bool(package) and frame is not None and not frame.f_code.co_filename.startswith("<frozen importlib")
        while frame is not None and (name := frame.f_globals.get("__name__", "")) not in CALLERS:
            stops &= frame.f_code.co_name != "<module>" or name.partition(".")[0] == package
            frame = frame.f_back
        if stops:
            raise TooLongError

    answered = signal.signal(signal.SIGALRM, look)
    before = signal.setitimer(signal.ITIMER_REAL, PATIENCE, AGAIN)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, answered or signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, *before)
