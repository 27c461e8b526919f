"""Rows with weights: checked, summed over the rows of each codebook entry, drawn."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import ShapeError

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


def training_rows(x: Tensor, weights: Tensor | None) -> tuple[Tensor, Tensor]:
    """x [N, d] without gradient, at least float32, and its weights [N], of mean 1; None: all equal.

    Raises ShapeError for no rows, ValueError for values that are not finite and for weights that are none.
    """
    if x.ndim != 2 or len(x) == 0:
        raise ShapeError("a codebook cannot be fitted to no rows")
    if not bool(torch.isfinite(x).all()):
        raise ValueError("values to quantize must be finite")
    x = x.detach() if x.dtype == torch.float64 else x.detach().to(torch.float32)
    if weights is None:
        return x, torch.ones(len(x), dtype=x.dtype, device=x.device)
    good = weights.shape == x.shape[:1] and bool(torch.isfinite(weights).all() and (weights >= 0).all())
    if not good or not float(weights.sum()) > 0:
        raise ValueError("weights must be one number >= 0 per row, finite, not all zero")
    found = weights.detach().to(x.device, torch.float64)
    return x, (found / found.mean()).to(x.dtype)
