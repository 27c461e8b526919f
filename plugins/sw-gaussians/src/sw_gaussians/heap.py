"""Memory that is not needed now: what the C library holds on to after large arrays, and numbers that lie in a file.

Both are hundreds of MB where a scene has a million Gaussians.
"""

from __future__ import annotations

import contextlib
import ctypes
import mmap
import shutil
import tempfile
import weakref
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

_LIES_IN_FILES: weakref.WeakSet[_Mapping] = weakref.WeakSet()


class _Mapping(mmap.mmap):
    """Pages of a file; a subclass, since only such can be referred to weakly."""


def trim() -> None:
    """Return it to the system: memory where the C library can, glibc; pages of files until they are looked at again."""
    let_go()
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def let_go() -> None:
    """Return pages of files to the system, which is quick: while rows are looked at block by block, too."""
    for each in in_files():
        each.madvise(mmap.MADV_DONTNEED)


def in_files() -> list[mmap.mmap]:
    """Mappings of the files that numbers lie in now."""
    return list(_LIES_IN_FILES)


def in_file(values: Tensor, folder: Path | None = None) -> Tensor:
    """Return a tensor of the CPU as one whose numbers lie in a file without a name, out of which they are read again
    after `trim`; as it is where there is no room for the file, or the system has no such pages.

    folder  of the file; None: that of temporary files
    """
    values = values.detach().contiguous()
    if values.device.type != "cpu" or not values.numel() or not hasattr(mmap, "MADV_DONTNEED"):
        return values
    try:
        if shutil.disk_usage(folder or tempfile.gettempdir()).free < 2 * values.nbytes:
            return values  # what is written into the folder needs room, too
        with tempfile.TemporaryFile(dir=folder, prefix=".sw-") as file:
            file.write(values.numpy().data)
            file.flush()
            pages = _Mapping(file.fileno(), values.nbytes)
    except OSError:
        return values
    _LIES_IN_FILES.add(pages)
    return torch.from_numpy(np.frombuffer(pages, values.numpy().dtype).reshape(values.shape))
