"""Sums over the rows of each codebook entry, and rows drawn by weight."""

from __future__ import annotations

import torch
from torch import Tensor

ROWS = {"cpu": 1 << 12, "cuda": 1 << 18}  # rows whose float64 copies are held at a time


def gather(x: Tensor, weights: Tensor, index: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Weighted counts [K] and sums [K, d] of the rows of each entry, float64."""
    counts = torch.zeros(size, dtype=torch.float64, device=x.device)
    sums = torch.zeros(size, x.shape[1], dtype=torch.float64, device=x.device)
    counts.index_add_(0, index, weights.to(torch.float64))
    step = ROWS.get(x.device.type, ROWS["cuda"])
    for start in range(0, len(x), step):
        part = slice(start, start + step)
        sums.index_add_(0, index[part], x[part].to(torch.float64) * weights[part, None].to(torch.float64))
    return counts, sums


def draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """`count` distinct rows (fewer if fewer have weight), by weight: the largest of u^(1/w). Any N, no limit."""
    keys = log_uniform(len(weights), generator, weights.device) / weights.to(torch.float64)  # w = 0: -inf
    return torch.topk(keys, min(count, int((weights > 0).sum()))).indices


def log_uniform(count: int, generator: torch.Generator, device: torch.device) -> Tensor:
    """log u, float64, u uniform in (0, 1): drawn where the generator lives."""
    u = torch.rand(count, generator=generator, device=generator.device, dtype=torch.float64)
    return torch.log(u.clamp_min(1e-300)).to(device)
