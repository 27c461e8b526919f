"""C++ and CUDA modules for torch, the fused loss and Adam, cores and memory of a process, progress on the terminal.

Importing this imports no torch.
"""

from __future__ import annotations

from splatwizard_native.errors import FULL as FULL
from splatwizard_native.errors import CompilerMissingError as CompilerMissingError
from splatwizard_native.errors import DeviceMemoryError as DeviceMemoryError
from splatwizard_native.errors import DiskFullError as DiskFullError
from splatwizard_native.errors import ForeseenError as ForeseenError
from splatwizard_native.errors import NativeBuildError as NativeBuildError
from splatwizard_native.errors import out_of_memory as out_of_memory
from splatwizard_native.errors import shortened as shortened
from splatwizard_native.lazy_imports import lazy_exports as lazy_exports

# Imported on first use: who only catches the errors, as every command does, need not wait for the rest.
MODULES = {
    "core_time": "CoreTime",
    "cores": "available_cores",
    "cuda_toolkit": "find_nvcc nvcc_version toolkit_mismatch",
    "errors": (
        "FULL CompilerMissingError DeviceMemoryError DiskFullError ForeseenError NativeBuildError out_of_memory "
        "shortened"
    ),
    "files": (
        "TEMPORARY bytes_with_named file_sha256 naming_full_disk new_folder remove_folder replacing scratch_folder "
        "sweep write_atomic write_json"
    ),
    "lazy_imports": "lazy_exports",
    "fused.activations": "activated",
    "fused.adam": "AdamUpdate adam_steps",
    "fused.in_backward": "end_offer offer_update offered_update",
    "fused.photometric": "Padding photometric",
    "interrupt": "InterruptGuard",
    "lock": "HeldError file_lock read_holder",
    "machine": "describe_machine",
    "memory": "MemoryMeter peak_rss_bytes reset_peak_rss rss_bytes synchronize",
    "module": "NativeModule",
    "operations": "operations",
    "progress": "Bar duration track",
    "random_states": "capture_random_states one_order_of_sums preserved_random_states restore_random_states seeded",
    "scalars": "Verdict read_scalars",
    "settings": "cache_root fast_enabled",
    "strict_json": "dump_strict json_reason load_strict",
    "toolchain": "Toolchain find_compiler",
    "work_clock": "loading_time work_time",
}
"""Module -> the names that are offered here."""

__all__, __getattr__ = lazy_exports(__name__, MODULES)
