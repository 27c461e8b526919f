"""C++ and CUDA modules for torch: found prebuilt, cached, or compiled on first use. Importing this imports no torch."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from splatwizard_native.errors import CompilerMissingError, NativeBuildError

if TYPE_CHECKING:
    from splatwizard_native.build import BuildRow, build_all, resolve_module
    from splatwizard_native.core_time import CoreTime
    from splatwizard_native.cores import available_cores
    from splatwizard_native.cuda_toolkit import find_nvcc, nvcc_version
    from splatwizard_native.fused.adam import AdamUpdate, adam_steps
    from splatwizard_native.fused.photometric import Padding, photometric
    from splatwizard_native.machine import describe_machine
    from splatwizard_native.memory import MemoryMeter, peak_rss_bytes, reset_peak_rss, rss_bytes, synchronize
    from splatwizard_native.module import NativeModule
    from splatwizard_native.random_states import (
        capture_random_states,
        preserved_random_states,
        restore_random_states,
        seeded,
    )
    from splatwizard_native.scalars import Verdict, read_scalars
    from splatwizard_native.settings import cache_root
    from splatwizard_native.toolchain import find_compiler

# Imported on first use: who only catches the errors, as every command does, need not wait for the rest.
_LATER = {
    "capture_random_states": "random_states",
    "preserved_random_states": "random_states",
    "restore_random_states": "random_states",
    "seeded": "random_states",
    "describe_machine": "machine",
    "Verdict": "scalars",
    "read_scalars": "scalars",
    "AdamUpdate": "fused.adam",
    "adam_steps": "fused.adam",
    "Padding": "fused.photometric",
    "photometric": "fused.photometric",
    "CoreTime": "core_time",
    "available_cores": "cores",
    "MemoryMeter": "memory",
    "peak_rss_bytes": "memory",
    "reset_peak_rss": "memory",
    "rss_bytes": "memory",
    "synchronize": "memory",
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
    "AdamUpdate",
    "BuildRow",
    "CompilerMissingError",
    "CoreTime",
    "MemoryMeter",
    "NativeBuildError",
    "NativeModule",
    "Padding",
    "Verdict",
    "adam_steps",
    "available_cores",
    "build_all",
    "cache_root",
    "capture_random_states",
    "describe_machine",
    "find_compiler",
    "find_nvcc",
    "nvcc_version",
    "peak_rss_bytes",
    "photometric",
    "preserved_random_states",
    "read_scalars",
    "reset_peak_rss",
    "resolve_module",
    "restore_random_states",
    "rss_bytes",
    "seeded",
    "synchronize",
]


def __getattr__(name: str) -> Any:
    if name not in _LATER:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_LATER[name]}"), name)
