"""C++ and CUDA modules for torch: found prebuilt, cached, or compiled on first use. Importing this imports no torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from splatwizard_native.errors import CompilerMissingError, NativeBuildError

if TYPE_CHECKING:
    from splatwizard_native.build import BuildRow, build_all, resolve_module
    from splatwizard_native.cuda_toolkit import find_nvcc, nvcc_version
    from splatwizard_native.module import NativeModule
    from splatwizard_native.settings import cache_root
    from splatwizard_native.toolchain import find_compiler

# Imported on first use: who only catches the errors, as every command does, need not wait for the rest.
_LATER = {
    "BuildRow": "build",
    "build_all": "build",
    "resolve_module": "build",
    "find_nvcc": "cuda_toolkit",
    "nvcc_version": "cuda_toolkit",
    "NativeModule": "module",
    "cache_root": "settings",
    "find_compiler": "toolchain",
}

__all__ = [
    "BuildRow",
    "CompilerMissingError",
    "NativeBuildError",
    "NativeModule",
    "build_all",
    "cache_root",
    "find_compiler",
    "find_nvcc",
    "nvcc_version",
    "resolve_module",
]


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
