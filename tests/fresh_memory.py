"""Memory that no allocator had before, for tests that measure how a resident set grows."""

import mmap

import numpy as np


def fresh_memory(size: int) -> np.ndarray:
    """[size] uint8, every page of it touched; given back to the system when the array goes.

    An ordinary allocation may be served from what the process freed before, and then nothing grows.
    """
    array = np.frombuffer(mmap.mmap(-1, size), dtype=np.uint8)
    array[:] = 1
    return array
