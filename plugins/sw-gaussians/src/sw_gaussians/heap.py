"""Memory that is free again, but held by the C library for what may come: after large arrays it is hundreds of MB."""

from __future__ import annotations

import contextlib
import ctypes


def trim() -> None:
    """Return it to the system, where the C library can: glibc."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
