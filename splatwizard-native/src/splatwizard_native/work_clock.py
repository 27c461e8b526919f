"""A clock of the work alone: it stands still while native modules are compiled or loaded.

Modules are loaded by whoever first calls one, in the middle of a training, an encoding or a decoding. What that takes
depends on what an earlier command has compiled, so it is no part of the time of any of them.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator

_lock = threading.Lock()
_loading_s = 0.0
_loads: list[float] = []  # when those began that go on now


def work_time() -> float:
    """Return seconds of the wall clock since some moment, without those of `loading_time`."""
    return time.perf_counter() - loading_time()


def loading_time() -> float:
    """Return the seconds for which this process has compiled or loaded native modules, those of now included."""
    with _lock:
        return _loading_s + (time.perf_counter() - min(_loads) if _loads else 0.0)


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Count a block as `loading_time`; what several threads load at once counts once."""
    global _loading_s
    with _lock:
        began = time.perf_counter()
        _loads.append(began)
    try:
        yield
    finally:
        with _lock:
            first = min(_loads)
            _loads.remove(began)
            _loading_s += (min(_loads) if _loads else time.perf_counter()) - first
