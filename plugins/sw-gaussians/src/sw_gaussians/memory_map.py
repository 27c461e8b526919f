"""Memory-mapped reading of files."""

from __future__ import annotations

import mmap
import os
import stat

from splatwizard_core.api import SceneError


def memory_map(path: str | os.PathLike[str]) -> bytes | memoryview:
    """Map a file into memory; the mapping lives as long as any view of it.

    Raises SceneError for what cannot be read and for what is no file, such as a pipe, which has no bytes to map.
    """
    where = os.fspath(path)
    try:
        # Opening a pipe waits for a writer; with O_NONBLOCK it does not. Windows has neither.
        descriptor = os.open(where, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
        try:
            told = os.fstat(descriptor)
            if not stat.S_ISREG(told.st_mode):
                kind = "a folder" if stat.S_ISDIR(told.st_mode) else "no file but a pipe or a device"
                raise SceneError(f"{where}: cannot be read: it is {kind}", path=where)
            if not told.st_size:
                return b""
            return memoryview(mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ))
        finally:
            os.close(descriptor)  # the map keeps a descriptor of its own
    except OSError as error:
        raise SceneError(f"{where}: cannot be read: {error.strerror}", path=where) from error
