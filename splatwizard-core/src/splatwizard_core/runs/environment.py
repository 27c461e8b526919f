"""Describe what a result was made with: packages, machine, seed."""

from __future__ import annotations

import importlib.metadata
from typing import Any

import torch

from splatwizard_core.plugins import PluginManager
from splatwizard_native import describe_machine


def describe_environment(plugins: PluginManager, device: torch.device, seed: int) -> dict[str, Any]:
    """Return plain values for the record: no machine name, no path, no user."""
    packages = {p.distribution: p.version for p in plugins.plugins}
    for name in ("torch", "numpy"):
        packages[name] = importlib.metadata.version(name)
    return {"packages": packages, "seed": seed, **describe_machine(device)}
