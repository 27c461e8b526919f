"""Backbones for LPIPS that are made for tests: right names and shapes, random values, a fixed seed."""

from __future__ import annotations

from pathlib import Path

import torch
from sw_metrics.lpips_weights import BACKBONES


def random_state(net: str) -> dict[str, torch.Tensor]:
    """A state dict with the convolutions of a backbone; activations keep their size through the layers."""
    generator = torch.Generator().manual_seed(sum(map(ord, net)))
    state: dict[str, torch.Tensor] = {}
    for key, shape in BACKBONES[net].shapes().items():
        scale = 0.05 if len(shape) == 1 else (2 / (shape[1] * shape[2] * shape[3])) ** 0.5
        state[key] = scale * torch.randn(shape, generator=generator)
    return state


def write_backbones(folder: Path, *nets: str) -> Path:
    """Files for metrics.lpips.weights; returns the folder."""
    for net in nets or BACKBONES:
        torch.save(random_state(net), folder / BACKBONES[net].file_name)
    return folder
