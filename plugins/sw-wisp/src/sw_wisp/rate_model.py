"""Rate model without context: a mean and a table of the file's Gaussians for each number and octree level.

What is trained is what is coded: means and tables are those that the file holds, and the bits of a step in training are
those of a Gaussian of the table's deviation.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from sw_wisp.nested import UNIT, index_bits
from sw_wisp.numbers import HIGHEST_LEVEL, LOWEST_LEVEL, NUMBERS
from sw_wisp.rate import bits, sigma_of
from sw_wisp.static import ENOUGH, MEAN_UNIT, StaticContext

TABLES = 64
WINDOW = 255
"""Indices that are told apart when a table is chosen; those beyond count as the last."""
LEVELS = HIGHEST_LEVEL - LOWEST_LEVEL + 1
LARGEST_MEAN = 32767
"""Of the file, in units of 16/4096 base steps."""


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


@functools.cache
def _costs(device: torch.device) -> Tensor:
    """[511,64]: bits of indices -255..255 under each table."""
    indices = np.arange(-WINDOW, WINDOW + 1)
    return torch.from_numpy(index_bits(np.arange(TABLES)[None], indices[:, None])).float().to(device)


class StaticRate(nn.Module):
    """Means and tables by level; no parameters, `measure` sets them.

    base_steps      [22] float64 quantiser steps
    row             [16] int64: which row of the next two serves levels 3..18
    means           [16,22] int64 in base steps, 12 fractional bits
    tables          [16,22] int64, 0..63
    """

    base_steps: Tensor
    row: Tensor
    means: Tensor
    tables: Tensor

    def __init__(self, base_steps: Tensor) -> None:
        super().__init__()
        self.register_buffer("base_steps", base_steps.double())
        self.register_buffer("row", torch.zeros(LEVELS, dtype=torch.int64))
        self.register_buffer("means", torch.zeros(LEVELS, NUMBERS, dtype=torch.int64))
        self.register_buffer("tables", torch.full((LEVELS, NUMBERS), 40))

    @torch.no_grad()
    def measure(self, values: Tensor, levels: Tensor) -> None:
        """Take the means, and for each the table of fewest bits, of values [N,22] at levels [N]."""
        place = levels - LOWEST_LEVEL
        counts = torch.bincount(place, minlength=LEVELS)
        own = (counts >= ENOUGH) | (counts == counts.max())
        at = torch.arange(LEVELS, device=levels.device)
        self.row.copy_(((at[:, None] - at).abs() + LEVELS * ~own).argmin(dim=1))
        served = self.row[place]  # [N]
        units = values.double() / self.base_steps * UNIT
        sums = units.new_zeros(LEVELS, NUMBERS).index_add_(0, served, units)
        whole = torch.bincount(served, minlength=LEVELS).clamp_min(1)[:, None]
        self.means.copy_((sums / whole / MEAN_UNIT).round().clamp(-LARGEST_MEAN, LARGEST_MEAN) * MEAN_UNIT)
        k = ((units - self.means[served]) / UNIT).round().long().clamp(-WINDOW, WINDOW) + WINDOW
        cell = (served[:, None] * NUMBERS + torch.arange(NUMBERS, device=levels.device)) * (2 * WINDOW + 1) + k
        found = torch.bincount(cell.flatten(), minlength=LEVELS * NUMBERS * (2 * WINDOW + 1))
        bits = found.view(LEVELS, NUMBERS, -1).float() @ _costs(values.device)  # [16,22,64]
        self.tables.copy_(bits.argmin(dim=2))

    def forecast(self, levels: Tensor) -> Forecast:
        """Predict the numbers of splats at levels [N]."""
        row = self.row[levels - LOWEST_LEVEL]
        means = (self.means * (self.base_steps / UNIT)).float()
        return Forecast(means[row], self.tables.float()[row], self.base_steps.float().expand(len(levels), NUMBERS))

    def rate(self, values: Tensor, forecast: Forecast) -> Tensor:
        """Return the bits [N,22] of the bins around values [N,22]; differentiable in values and forecast."""
        return bits(values - forecast.mean, sigma_of(forecast.scale, forecast.steps), forecast.steps)

    def exact(self) -> StaticContext:
        """Return the same distributions in the integers of the file."""
        used, row = torch.unique(self.row, return_inverse=True)
        means, tables = self.means[used].cpu().numpy(), self.tables[used].cpu().numpy()
        return StaticContext(row.cpu().numpy(), means, tables, np.full(NUMBERS, UNIT, np.int64))
