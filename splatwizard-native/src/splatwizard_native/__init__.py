"""C++ and CUDA modules for torch, the fused loss and Adam, cores and memory of a process, progress on the terminal.

Importing this imports no torch.
"""

from __future__ import annotations

from splatwizard_native.lazy_imports import lazy_exports

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
    "lock": "HeldError file_lock read_holder",
    "memory": "MemoryMeter peak_rss_bytes reset_peak_rss rss_bytes synchronize",
    "module": "NativeModule",
    "operations": "operations",
    "progress": "Bar duration track",
    "settings": "cache_root fast_enabled",
    "strict_json": "dump_strict json_reason load_strict",
    "toolchain": "Toolchain find_compiler",
    "work_clock": "loading_time work_time",
}
"""Module -> the names that are offered here; each is imported on first use. `__init__.pyi` repeats them."""

__all__, __getattr__ = lazy_exports(__name__, MODULES)
