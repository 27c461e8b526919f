"""A clock of the work alone: it stands still while native modules are compiled or loaded.

Modules are loaded by whoever first calls one, in the middle of a training, an encoding or a decoding. What that takes
depends on what an earlier command has compiled, so it is no part of the time of any of them.
"""

import contextlib
import time
from collections.abc import Iterator

_loading_s = 0.0


def work_time() -> float:
    """Return seconds of the wall clock since some moment, without those of `loading_time`."""
    return time.perf_counter() - _loading_s


def loading_time() -> float:
    """Return the seconds for which this process has compiled or loaded native modules."""
    return _loading_s


@contextlib.contextmanager
def loading() -> Iterator[None]:
    """Count a block as `loading_time` when it ends."""
    global _loading_s
    began = time.perf_counter()
    try:
        yield
    finally:
        _loading_s += time.perf_counter() - began
