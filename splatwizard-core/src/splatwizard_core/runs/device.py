"""Choose where a run computes, and with how many threads."""

from __future__ import annotations

import os

import torch

from splatwizard_core.base.progress import several
from splatwizard_core.errors import CapabilityError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_native import available_cores


def choose_device(asked: str, plugins: PluginManager) -> torch.device:
    """Return the device that `asked` means: "cpu", "cuda", or "auto": CUDA if a compiled rasterizer can run there.

    Raises CapabilityError if CUDA is asked for and there is none.
    """
    there = asked != "cpu" and torch.cuda.is_available()
    if asked == "cuda" and not there:
        raise CapabilityError("--device cuda: torch sees no CUDA device here; use --device cpu", missing=["cuda"])
    return torch.device("cuda" if there and (asked == "cuda" or cuda_rasterizers(plugins)) else "cpu")


def device_reason(asked: str, chosen: torch.device, plugins: PluginManager) -> str:
    """Return one line for the user: where a run computes, and why there."""
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
    return f"computing on cpu, {several(torch.get_num_threads(), 'thread')} ({why})"


def cuda_rasterizers(plugins: PluginManager) -> list[str]:
    """List our rasterizers with CUDA kernels that say they can run here; a slow reference does not count."""
    infos = [RasterizerInfo.from_entry(entry) for entry in plugins.rasterizers if not entry.foreign]
    return [i.name for i in infos if "cuda" in i.devices and i.speed > 0 and i.obstacle("cuda") is None]


def set_threads(asked: int) -> int:
    """Let torch use `asked` CPU threads and return how many it uses.

    asked   0: as many as OMP_NUM_THREADS says, else as many cores as this process may use
    """
    if asked > 0:
        torch.set_num_threads(asked)
    elif not os.environ.get("OMP_NUM_THREADS"):
        torch.set_num_threads(available_cores())
    return torch.get_num_threads()
