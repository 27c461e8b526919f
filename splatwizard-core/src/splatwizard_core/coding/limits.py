"""The most that a file may decode to: one rule for the single file and for the formats of other programs."""

from __future__ import annotations

import os

from splatwizard_core.errors import ConfigError

FREE = 1 << 24
"""Bytes of decoded model that any file may stand for, and EXPANSION more for each of its bytes."""
EXPANSION = 256  # real files are below 100
EXPANSION_VARIABLE = "SPLATWIZARD_MAX_EXPANSION"


def decoded_limit(size: int) -> int:
    """The most bytes of decoded model that a file of `size` bytes may claim; the environment may allow more.

    A few bytes must not make a reader fill its memory. A file that claims more is refused, and none is written.
    """
    text = os.environ.get(EXPANSION_VARIABLE) or str(EXPANSION)
    if not (text.isascii() and text.isdecimal() and len(text) <= 9):
        raise ConfigError(f"{EXPANSION_VARIABLE} is {text!r:.40}, must be a number of bytes", key=EXPANSION_VARIABLE)
    return FREE + int(text) * size


def beyond_limit(decoded: int, size: int) -> str | None:
    """Reason to refuse a file of `size` bytes that claims `decoded` bytes, and how to read it; None: it may."""
    most = decoded_limit(size)
    needed = -(-(decoded - FREE) // max(size, 1))
    reason = f"{decoded:,} bytes in memory, a file of {size:,} may stand for at most {most:,}; if you trust it, set"
    return f"{reason} {EXPANSION_VARIABLE}={needed}" if decoded > most else None
