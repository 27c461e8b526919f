"""What the fuzz tests need besides `sw_kit.hostile_files`: a process without checksums, and its open handles.

Checksums inside the coded streams are in the way of hostile payloads, so inside `blind` every CRC-32 in the process is
0, in the files as in the decoder, and nothing but the parsers themselves stands in the way.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from splatwizard_core.base.files import _numbering


@contextlib.contextmanager
def blind() -> Iterator[None]:
    """Every CRC-32 is 0 inside."""
    _numbering()  # kept for the process, and a CRC-32 too
    with pytest.MonkeyPatch.context() as patch:
        for name in ("zlib.crc32", "sw_codecs.bits.checksum.crc32"):  # of the core and of sw-codecs
            patch.setattr(name, lambda data, value=0: 0)
        yield


def open_handles() -> int:
    """How many file handles this process holds."""
    return len(os.listdir("/proc/self/fd")) if Path("/proc/self/fd").is_dir() else 0
