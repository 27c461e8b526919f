"""Where a run computes, and with how many threads."""

from __future__ import annotations

import importlib
import os
from typing import Any

import torch

from splatwizard_core.cores import available_cores
from splatwizard_core.errors import CapabilityError
from splatwizard_core.plugins import PluginManager


def choose_device(asked: str, plugins: PluginManager) -> torch.device:
    """The device that `asked` means: "cpu", "cuda", or "auto", which is CUDA if a compiled rasterizer can run there.

    Raises CapabilityError if CUDA is asked for and there is none.
    """
    if asked == "cpu":
        return torch.device("cpu")
    if asked == "cuda":
        if not torch.cuda.is_available():
            raise CapabilityError("--device cuda: torch sees no CUDA device here; use --device cpu", missing=["cuda"])
        return torch.device("cuda")
    if torch.cuda.is_available() and cuda_rasterizers(plugins):
        return torch.device("cuda")
    return torch.device("cpu")


def device_reason(asked: str, chosen: torch.device, plugins: PluginManager) -> str:
    """One line for the user: where a run computes, and why there."""
    if chosen.type == "cuda":
        name = torch.cuda.get_device_name(chosen)
        served = ", ".join(cuda_rasterizers(plugins))
        why = "--device cuda" if asked == "cuda" else f"it is here, and there are kernels for it: {served}"
        return f"computing on cuda, {name} ({why})"
    if asked == "cpu":
        why = "--device cpu"
    elif not torch.cuda.is_available():
        why = "torch sees no CUDA device"
    else:
        why = f"no rasterizer can run on {torch.cuda.get_device_name()}; `sw doctor` says why"
    threads = torch.get_num_threads()
    return f"computing on cpu, {threads} thread{'s' if threads > 1 else ''} ({why})"


def cuda_rasterizers(plugins: PluginManager) -> list[str]:
    """The installed rasterizers with CUDA kernels that say they can run here; the slow reference does not count."""
    found = []
    for entry in plugins.rasterizers:
        if "cuda" not in entry.declared.get("devices", ()) or entry.declared.get("speed", 0) <= 0:
            continue
        probe = entry.declared.get("available")
        minimum = tuple(entry.declared.get("min_cc") or (0, 0))
        if torch.cuda.get_device_capability() >= minimum and (probe is None or _call(probe) is None):
            found.append(entry.name)
    return found


def _call(target: str) -> Any:
    module, _, function = target.partition(":")
    return getattr(importlib.import_module(module), function)()


def set_threads(asked: int) -> int:
    """Let torch use `asked` CPU threads and return how many it uses.

    asked   0: as many as OMP_NUM_THREADS says, else as many cores as this process may use
    """
    if asked > 0:
        torch.set_num_threads(asked)
    elif not os.environ.get("OMP_NUM_THREADS"):
        torch.set_num_threads(available_cores())
    return torch.get_num_threads()
