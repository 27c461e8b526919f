"""Stand-ins for rounded numbers in training: noise, soft rounding, rounding with a straight-through gradient."""

from __future__ import annotations

import math
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Rounding:
    """Values that are drawn, and whose bits are counted, in place of exact ones.

    phase           one of this module's
    sharpness       of soft rounding, 1..most; noise fades as it rises
    drawn_noise     what `noise` returns; None: it draws
    soft            [2] sharpness s and 1 / (2 tanh(s/2)), which kernels read as they run: a step may be replayed
    """

    phase: str
    sharpness: float = 1.0
    most: float = 8.0
    drawn_noise: Tensor | None = None
    soft: Tensor | None = None

    def noise(self, values: Tensor) -> Tensor | None:
        """Draw what `drawn` needs for values of this shape: numbers of U(-1/2, 1/2), fewer and fewer; None: nothing.

        From torch's own generator, which a checkpoint holds.
        """
        if self.drawn_noise is not None or self.phase not in (NOISE, SOFT):
            return self.drawn_noise
        return self.draw(torch.empty_like(values, requires_grad=False))

    def draw(self, noise: Tensor) -> Tensor:
        """Draw into `noise` and return it."""
        width = 1.0 if self.phase == NOISE else max(0.0, 1 - (self.sharpness - 1) / (self.most - 1))
        return noise.uniform_(-width / 2, width / 2)

    def drawn(self, values: Tensor, mean: Tensor, steps: Tensor, noise: Tensor | None) -> Tensor:
        """Return values [N,C] as they are drawn; differentiable, as far as rounding is.

        mean, steps     [N,C] where the lattice of each number has its zero, and how wide its cells are
        noise           [N,C] from `noise`
        """
        if self.phase in (FLOAT, FINAL):
            return values
        if self.phase == NOISE:
            assert noise is not None
            return values + noise * steps
        offsets = (values - mean) / steps
        if self.phase == SOFT:
            assert noise is not None
            return mean + steps * soft_round(soft_round(offsets, self.sharpness) + noise, self.sharpness)
        return mean + steps * (offsets + (offsets.round() - offsets).detach())


AS_THEY_ARE = Rounding(FLOAT)
