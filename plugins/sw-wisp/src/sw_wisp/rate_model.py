"""Rate model without context: a mean, a deviation and a step for each number and octree level.

What is trained is what is coded: means and deviations lie on the lattice of the file's integers (12 fractional bits),
and the bits of a step in training are those of the file's Gaussian of the same parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from sw_codecs.entropy.rates import gaussian_bits
from sw_wisp.numbers import HIGHEST_LEVEL, NUMBERS

TOP = 63
"""Highest table of the file's Gaussians; they are linear in the logarithm of the deviation."""
NARROWEST, RANGE = 0.05, 1280.0
"""Deviation of table 0 in steps, and how much wider table 63 is."""
UNIT = 4096
"""Integers of the file have 12 fractional bits."""
LEAST = 2.0**-16
"""Floor of a probability in the loss."""
ENOUGH = 64
"""Splats that a level needs for means and deviations of its own; others share those of all."""


@dataclass(frozen=True)
class Forecast:
    """Distributions of the 22 numbers of N splats, each [N,22].

    mean    in the units of the numbers
    scale   number of the table, 0..63: linear in the logarithm of the deviation in steps
    steps   quantiser steps
    """

    mean: Tensor
    scale: Tensor
    steps: Tensor

    def rows(self, rows: Tensor) -> Forecast:
        """Return some of the rows."""
        return Forecast(self.mean[rows], self.scale[rows], self.steps[rows])


def deviation(scale: Tensor, steps: Tensor) -> Tensor:
    """Return standard deviations for table numbers, clamped to 0..63, and quantiser steps; differentiable."""
    return steps * NARROWEST * torch.exp(scale.clamp(0, TOP) * (math.log(RANGE) / TOP))


def scale_of(deviations: Tensor, steps: Tensor) -> Tensor:
    """Return the table numbers, 0..63 with a fraction, of standard deviations; the inverse of `deviation`."""
    ratio = (deviations / (steps * NARROWEST)).clamp_min(1e-12)
    return (ratio.log() * (TOP / math.log(RANGE))).clamp(0, TOP)


class StaticRate(nn.Module):
    """Means, deviations and steps by level; no parameters, `measure` sets them.

    base_steps      [22]
    means, scales   [19,22] by level 0..18: mean, and number of the table
    """

    base_steps: Tensor
    means: Tensor
    scales: Tensor
    position_bits: Tensor

    def __init__(self, base_steps: Tensor) -> None:
        super().__init__()
        levels = HIGHEST_LEVEL + 1
        self.register_buffer("base_steps", base_steps.float())
        self.register_buffer("means", torch.zeros(levels, NUMBERS))
        self.register_buffer("scales", torch.full((levels, NUMBERS), 40.0))
        self.register_buffer("position_bits", 3.0 * torch.arange(levels))

    @torch.no_grad()
    def measure(self, values: Tensor, levels: Tensor) -> None:
        """Take means and deviations of values [N,22] at levels [N], rounded to what the file can say."""
        count = HIGHEST_LEVEL + 1
        values = values.double()
        ones = values.new_zeros(count).index_add_(0, levels, values.new_ones(len(values)))
        sums = values.new_zeros(count, NUMBERS).index_add_(0, levels, values)
        squares = values.new_zeros(count, NUMBERS).index_add_(0, levels, values.square())
        whole = max(len(values), 1)
        overall, spread = sums.sum(0) / whole, squares.sum(0) / whole
        own = (ones >= ENOUGH)[:, None]
        n = ones.clamp_min(1)[:, None]
        means = torch.where(own, sums / n, overall)
        variances = torch.where(own, squares / n, spread) - means.square()
        base = self.base_steps.double()
        self.means.copy_((means / base * UNIT).round() / UNIT * base)
        scales = scale_of(variances.clamp_min(0).sqrt(), base)
        self.scales.copy_((scales * UNIT).round() / UNIT)

    def forecast(self, levels: Tensor) -> Forecast:
        """Predict the numbers of splats at levels [N]."""
        steps = self.base_steps.expand(len(levels), NUMBERS)
        return Forecast(self.means[levels], self.scales[levels], steps)

    def rate(self, values: Tensor, forecast: Forecast) -> Tensor:
        """Return the bits [N,22] of the bins around values [N,22]; differentiable in values and forecast."""
        return gaussian_bits(
            values, forecast.mean, deviation(forecast.scale, forecast.steps), forecast.steps, p_min=LEAST
        )
