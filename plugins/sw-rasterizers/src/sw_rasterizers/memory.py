"""Memory for what the kernels on the CPU read and write.

A training step needs the same 100 MB of gradients and working space again and again. From malloc they come as fresh
pages each time, and clearing those costs as much as the kernels that fill them (250k Gaussians: 14,000 page faults,
25 ms a step). Here a block that is free again is handed out again; the total kept never exceeds what was in use at
once, the longest unused block going first.
"""

from __future__ import annotations

import contextlib
import math
import mmap
import threading
import weakref
from collections import deque

import torch
from torch import Tensor

PAGE = 1 << 21
"""Bytes of a huge page."""
SMALLEST = 1 << 20
"""Bytes of the smallest tensor that is kept; malloc keeps smaller ones itself."""


def empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return an uninitialised tensor on the CPU, at a multiple of 64 bytes."""
    count = math.prod(shape)
    if count * dtype.itemsize < SMALLEST:
        return torch.empty(shape, dtype=dtype)
    return torch.frombuffer(_RECYCLER.take(count * dtype.itemsize), dtype=dtype, count=count).view(shape)


def give_back() -> None:
    """Return the blocks that nothing uses to the system: what comes next needs the memory for something else."""
    _RECYCLER.give_back()


class _Recycler:
    def __init__(self) -> None:
        self._lock = threading.Lock()
        # Tensors may be freed at any time, also while the lock is held: then the block only waits here.
        self._returned: deque[mmap.mmap] = deque()
        self._idle: list[mmap.mmap] = []  # longest unused first
        self._used_bytes = self._most_used = 0

    def give_back(self) -> None:
        """Forget the idle blocks, and how much was in use at once."""
        with self._lock:
            while self._returned:
                self._used_bytes -= len(self._returned.popleft())
            self._idle.clear()
            self._most_used = self._used_bytes

    def take(self, count: int) -> memoryview:
        """Return a view of at least so many bytes, which become free with it."""
        size = -(-count // PAGE) * PAGE
        with self._lock:
            while self._returned:
                self._idle.append(self._returned.popleft())
                self._used_bytes -= len(self._idle[-1])
            fitting = [block for block in self._idle if size <= len(block) <= 2 * size]
            if fitting:
                block = min(fitting, key=len)
                self._idle.remove(block)
            else:
                block = _pages(size)
            self._used_bytes += len(block)
            self._most_used = max(self._most_used, self._used_bytes)
            idle_bytes = sum(map(len, self._idle))
            while idle_bytes + self._used_bytes > self._most_used:
                idle_bytes -= len(self._idle.pop(0))
        view = memoryview(block)
        weakref.finalize(view, self._returned.append, block).atexit = False
        return view


def _pages(size: int) -> mmap.mmap:
    """Return fresh memory of this process alone."""
    if not hasattr(mmap, "MAP_PRIVATE"):
        return mmap.mmap(-1, size)
    try:
        block = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    except OSError as error:
        raise MemoryError(f"no memory for {size:,} bytes") from error
    if hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):  # only a hint
            block.madvise(mmap.MADV_HUGEPAGE)
    return block


_RECYCLER = _Recycler()
