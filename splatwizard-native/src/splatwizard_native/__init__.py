"""C++ and CUDA modules for torch: found prebuilt, cached, or compiled on first use. Importing this imports no torch."""

from splatwizard_native.build import BuildRow, build_all, resolve_module
from splatwizard_native.cuda_toolkit import find_nvcc, nvcc_version
from splatwizard_native.errors import CompilerMissingError, NativeBuildError
from splatwizard_native.module import NativeModule
from splatwizard_native.settings import cache_root
from splatwizard_native.toolchain import find_compiler

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
