"""Stand-ins for rounded numbers in training: noise, soft rounding, rounding with a straight-through gradient."""

from __future__ import annotations

import math

import torch
from torch import Tensor

FLOAT, NOISE, SOFT, HARD, FINAL = "float", "noise", "soft", "hard", "final"
"""Phases of a training: numbers as they are; uniform noise of a step; soft rounding; rounding; integers fixed."""


def soft_round(y: Tensor, sharpness: float) -> Tensor:
    """Return floor(y) + 1/2 + tanh(a (y - floor(y) - 1/2)) / (2 tanh(a/2)) for sharpness a > 0; differentiable.

    Nearly y itself at a = 1, nearly round(y) at a = 8. Source: Agustsson and Theis (arXiv 2006.09952).
    """
    floor = y.detach().floor()
    return floor + 0.5 + torch.tanh(sharpness * (y - floor - 0.5)) / (2 * math.tanh(sharpness / 2))


def disturbed(
    values: Tensor, mean: Tensor, steps: Tensor, phase: str, sharpness: float = 1.0, most: float = 8.0
) -> Tensor:
    """Return what is drawn, and whose bits are counted, for values [N,C]; differentiable, as far as rounding is.

    mean, steps     [N,C] where the lattice of each number has its zero, and how wide its cells are
    phase           one of this module's
    sharpness       of soft rounding, 1..most; noise fades as it rises

    Random numbers come from torch's own generator, which a checkpoint holds.
    """
    if phase in (FLOAT, FINAL):
        return values
    if phase == NOISE:
        return values + (torch.rand_like(values) - 0.5) * steps
    offsets = (values - mean) / steps
    if phase == SOFT:
        noise = (torch.rand_like(values) - 0.5) * max(0.0, 1 - (sharpness - 1) / (most - 1))
        return mean + steps * soft_round(soft_round(offsets, sharpness) + noise, sharpness)
    return mean + steps * (offsets + (offsets.round() - offsets).detach())
