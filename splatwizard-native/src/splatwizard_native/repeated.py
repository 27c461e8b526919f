"""Calls of an operation that are alike, as those of a training's steps: the first one is checked."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from typing import Any

import torch

PLAIN = {int, float, bool, tuple}  # types of values that are handed over as they are


class Repeated(threading.local):
    """An operation that a training calls at each step, alike: the first call is checked, later ones only change values.

    face    Python module of the face
    name    of the operation
    """

    def __init__(self, face: Any, name: str) -> None:
        self._face, self._name, self._call, self._form, self._values = face, name, None, None, dict[str, Any]()

    def __call__(self, fixed: Callable[[], dict[str, Any]], form: Any = None, /, **changed: Any) -> Any:
        """Call it, and return its struct, each time the same one.

        fixed   gives the arguments that are the same at all calls
        form    all else that checks look at; a call of another form than the last one is checked
        changed tensors of the form that those of the first call had, lists of them, numbers, tuples of numbers
        """
        call: Any = self._call
        if call is None or form != self._form:
            self._call = None  # until it has been found good
            call = getattr(self._face, self._name)(**fixed(), **changed)
            self._call, self._form, self._values = call, form, {}
            module = self._face.MODULE
            self._reference, self._told = ctypes.byref(call), getattr(module.library, f"{module.name}_last_error")
            self._function = getattr(module.library, f"{module.name}_{self._name}")
            return call
        values = self._values  # memory is often where it was
        for name, value in changed.items():
            if value is not None and type(value) not in PLAIN:
                value = tuple([x.data_ptr() for x in value]) if type(value) is list else value.data_ptr()
            if name not in values or values[name] != value:
                setattr(call, name, value)
                values[name] = value
        if call.device >= 0:
            call.stream = torch._C._cuda_getCurrentRawStream(call.device)
        if self._function(self._reference) != 0:
            raise RuntimeError(f"{self._name}: {self._told().decode()}")
        return call
