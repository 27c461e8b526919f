"""C++ and CUDA modules for torch, the fused loss and Adam, cores and memory of a process, progress on the terminal.

Importing this imports no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatwizard_native.errors import FULL as FULL
from splatwizard_native.errors import CompilerMissingError as CompilerMissingError
from splatwizard_native.errors import DeviceMemoryError as DeviceMemoryError
from splatwizard_native.errors import DiskFullError as DiskFullError
from splatwizard_native.errors import ForeseenError as ForeseenError
from splatwizard_native.errors import NativeBuildError as NativeBuildError
from splatwizard_native.errors import out_of_memory as out_of_memory
from splatwizard_native.errors import shortened as shortened
from splatwizard_native.lazy_imports import lazy_exports as lazy_exports

if TYPE_CHECKING:
    from splatwizard_native.core_time import CoreTime as CoreTime
    from splatwizard_native.cores import available_cores as available_cores
    from splatwizard_native.cuda_toolkit import find_nvcc as find_nvcc
    from splatwizard_native.cuda_toolkit import nvcc_version as nvcc_version
    from splatwizard_native.cuda_toolkit import toolkit_mismatch as toolkit_mismatch
    from splatwizard_native.files import TEMPORARY as TEMPORARY
    from splatwizard_native.files import bytes_with_named as bytes_with_named
    from splatwizard_native.files import file_sha256 as file_sha256
    from splatwizard_native.files import naming_full_disk as naming_full_disk
    from splatwizard_native.files import new_folder as new_folder
    from splatwizard_native.files import remove_folder as remove_folder
    from splatwizard_native.files import replacing as replacing
    from splatwizard_native.files import scratch_folder as scratch_folder
    from splatwizard_native.files import sweep as sweep
    from splatwizard_native.files import write_atomic as write_atomic
    from splatwizard_native.files import write_json as write_json
    from splatwizard_native.fused.activations import activated as activated
    from splatwizard_native.fused.adam import AdamUpdate as AdamUpdate
    from splatwizard_native.fused.adam import adam_steps as adam_steps
    from splatwizard_native.fused.in_backward import end_offer as end_offer
    from splatwizard_native.fused.in_backward import offer_update as offer_update
    from splatwizard_native.fused.in_backward import offered_update as offered_update
    from splatwizard_native.fused.photometric import Padding as Padding
    from splatwizard_native.fused.photometric import photometric as photometric
    from splatwizard_native.interrupt import InterruptGuard as InterruptGuard
    from splatwizard_native.machine import describe_machine as describe_machine
    from splatwizard_native.memory import MemoryMeter as MemoryMeter
    from splatwizard_native.memory import peak_rss_bytes as peak_rss_bytes
    from splatwizard_native.memory import reset_peak_rss as reset_peak_rss
    from splatwizard_native.memory import rss_bytes as rss_bytes
    from splatwizard_native.memory import synchronize as synchronize
    from splatwizard_native.module import NativeModule as NativeModule
    from splatwizard_native.progress import Bar as Bar
    from splatwizard_native.progress import duration as duration
    from splatwizard_native.progress import track as track
    from splatwizard_native.random_states import capture_random_states as capture_random_states
    from splatwizard_native.random_states import one_order_of_sums as one_order_of_sums
    from splatwizard_native.random_states import preserved_random_states as preserved_random_states
    from splatwizard_native.random_states import restore_random_states as restore_random_states
    from splatwizard_native.random_states import seeded as seeded
    from splatwizard_native.scalars import Verdict as Verdict
    from splatwizard_native.scalars import read_scalars as read_scalars
    from splatwizard_native.settings import cache_root as cache_root
    from splatwizard_native.settings import fast_enabled as fast_enabled
    from splatwizard_native.strict_json import dump_strict as dump_strict
    from splatwizard_native.strict_json import json_reason as json_reason
    from splatwizard_native.strict_json import load_strict as load_strict
    from splatwizard_native.toolchain import Toolchain as Toolchain
    from splatwizard_native.toolchain import find_compiler as find_compiler
    from splatwizard_native.work_clock import loading_time as loading_time
    from splatwizard_native.work_clock import work_time as work_time

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
    "machine": "describe_machine",
    "memory": "MemoryMeter peak_rss_bytes reset_peak_rss rss_bytes synchronize",
    "module": "NativeModule",
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
