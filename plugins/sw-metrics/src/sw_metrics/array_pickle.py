"""Reads a pickle of nested dictionaries of numpy arrays, from anybody, without running anything in it.

A pickle is a program that may call any function of any package. Here it gets two stand-ins in place of numpy's own
classes, which keep what they are told and check it, and no other name. Its memory is at most a few times its size.
"""

from __future__ import annotations

import io
import math
import pickle
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import UserInputError

MODULES = ("numpy.core.multiarray", "numpy._core.multiarray")
"""Where numpy 1 and numpy 2 keep what makes an empty array."""
MAX_DIMENSIONS = 8
MAX_DEPTH = 8  # dictionaries in dictionaries
MAX_NODES = 10_000  # a dictionary may stand in a file once and in the tree very often


class _Dtype:
    """In place of numpy.dtype: "f4", "f8" and their byte order."""

    def __init__(self, code: Any, *_: Any) -> None:
        if code not in ("f4", "f8"):
            raise pickle.UnpicklingError(f"an array of {code!r:.20} is none of floating-point numbers")
        self.code, self.order = str(code), "<"

    def __setstate__(self, state: Any) -> None:
        self.order = state[1]
        if self.order not in ("<", ">"):
            raise pickle.UnpicklingError(f"{self.order!r:.20} is no byte order")


class _Array:
    """In place of numpy.ndarray, and of the function that makes an empty one: shape, type, bytes."""

    values: NDArray[np.floating[Any]]

    def __init__(self, *_: Any) -> None:
        """Take what numpy makes an empty array from, which says nothing."""

    def __setstate__(self, state: Any) -> None:
        _, shape, dtype, is_fortran, content = state
        if not isinstance(dtype, _Dtype) or not isinstance(content, bytes) or not _is_shape(shape):
            raise pickle.UnpicklingError("an array without shape, type or content")
        kind = np.dtype(dtype.order + dtype.code)
        if len(content) != math.prod(shape) * kind.itemsize:
            raise pickle.UnpicklingError(f"an array of shape {shape} has {len(content):,} bytes")
        self.values = np.frombuffer(content, kind).reshape(shape, order="F" if is_fortran else "C")


def _is_shape(shape: Any) -> bool:
    return isinstance(shape, tuple) and len(shape) <= MAX_DIMENSIONS and all(type(n) is int and n >= 0 for n in shape)


# The class in Python: that in C sets aside as much memory as a file claims to need.
class _Arrays(pickle._Unpickler):
    """Unpickler that knows arrays alone."""

    def find_class(self, module: str, name: str) -> Any:
        """Give the stand-in for one of numpy's names. Raises UnpicklingError for any other."""
        if (module == "numpy" and name == "ndarray") or (module in MODULES and name == "_reconstruct"):
            return _Array
        if (module, name) == ("numpy", "dtype"):
            return _Dtype
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is no part of an array")


def read_arrays(content: bytes, name: str) -> dict[tuple[str, ...], NDArray[np.floating[Any]]]:
    """Read all arrays of a pickle by their path of keys, such as ("VGG16_0", "Conv_0", "kernel").

    name    how messages call it

    What is neither a dictionary nor an array is passed over. Raises UserInputError in one line for anything else than
    such a pickle.
    """
    found: dict[tuple[str, ...], NDArray[np.floating[Any]]] = {}
    try:
        pending: list[tuple[tuple[str, ...], Any]] = [((), _Arrays(io.BytesIO(content)).load())]
        for count, (path, node) in enumerate(pending):
            if count > MAX_NODES or len(path) > MAX_DEPTH:
                raise pickle.UnpicklingError("its dictionaries are too many, or too deep")
            if isinstance(node, _Array):
                found[path] = node.values
            elif isinstance(node, dict):
                pending += [((*path, str(key)), value) for key, value in node.items()]
    # Bytes from a stranger: whatever the reader stumbles over, it is the file that is wrong.
    except Exception as error:
        text = " ".join(str(error).split()) or "it ends too early"
        raise UserInputError(f"{name} is no pickle of arrays: {type(error).__name__}: {text:.120}") from error
    return found
