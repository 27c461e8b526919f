"""Operations of native modules as Python functions, and the threads that all of them share."""

from __future__ import annotations

import ctypes
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from splatwizard_native.face import OPERATION, operation, read_structs, structure
from splatwizard_native.module import NativeModule
from splatwizard_native.waiting import openmp_libraries

POOL = NativeModule(
    name="splatwizard_pool",
    package="splatwizard_native",
    sources=("pool/pool.cpp",),
    headers=("pool/*.h",),
    without="native code runs on one thread",
    face="pool/face.h",
)


def operations(module: NativeModule, face: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of the Python module `face` that offers operations and structs of a native one."""

    def find(name: str) -> Any:
        header = module.face_header
        structs = read_structs(header)
        if name in structs:
            found = structure(name, structs[name])
        elif (module.name, name) in OPERATION.findall(header):
            function = getattr(module.library, f"{module.name}_{name}")
            told = getattr(module.library, f"{module.name}_last_error")
            run = None if module.cuda_sources else pool_runner()
            found = operation(name, structs[f"{name}_call"], function, told, run, on_gpu=bool(module.cuda_sources))
        else:
            raise AttributeError(f"'{module.name}' has no operation '{name}'")
        setattr(sys.modules[face], name, found)
        return found

    return find


@functools.cache
def pool_runner() -> int | None:
    """Return the address of the function that runs loops on the shared threads; None: there is none here."""
    import torch

    if not POOL.try_load():
        return None
    # The OpenMP of torch, not that of another package.
    for path in openmp_libraries():
        if Path(path).is_relative_to(Path(torch.__file__).parent):
            gomp = ctypes.cast(ctypes.CDLL(path).GOMP_parallel, ctypes.c_void_p)
            POOL.library.splatwizard_pool_borrow(gomp)
    return ctypes.cast(POOL.library.splatwizard_pool_run, ctypes.c_void_p).value
