"""Rate models: how the 22 numbers of a splat are distributed, in training and for the file alike.

`StaticRate`: a mean and a table of the file's Gaussians for each number and octree level. `PyramidRate`: networks that
see running means of the splats before. What is trained is what is coded: bits of a training step are those of a
Gaussian of the table's deviation, and `exact` is what the file holds.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor, nn

from sw_wisp.context import ContextNetworks
from sw_wisp.fast.kernels import fit_kernels
from sw_wisp.fast.predicted import bits_of as fast_bits_of
from sw_wisp.fast.predicted import predicted
from sw_wisp.fast.running_means import pyramid_of
from sw_wisp.nested import UNIT, index_bits
from sw_wisp.numbers import BLOCKS, HIGHEST_LEVEL, LOWEST_LEVEL, NUMBERS
from sw_wisp.predicting import STEPS_OF
from sw_wisp.pyramid import walked_features
from sw_wisp.rate import Forecast, bits, level_of, sigma_of
from sw_wisp.rounding import AS_THEY_ARE, HARD, Rounding
from sw_wisp.static import ENOUGH, MEAN_UNIT, StaticContext

if TYPE_CHECKING:
    from sw_wisp.predicting import PyramidContext

TABLES = 64
WINDOW = 255
"""Indices that are told apart when a table is chosen; those beyond count as the last."""
LEVELS = HIGHEST_LEVEL - LOWEST_LEVEL + 1
FIT_LR, LAST_FIT_LR, FIT_BATCH = 0.01, 0.05, 2048
"""Of `PyramidRate.fit`: Adam step size, that of the last update over it, splats of an update."""
LEAST_MULTIPLIER, MOST_MULTIPLIER = 1 / 64, 1.99
"""Bounds of the steps to begin with, in those of `sw_wisp.numbers`."""
LARGEST_MEAN = 32767
"""Of the file, in units of 16/4096 base steps."""


@dataclass(frozen=True)
class Placed:
    """Splats as a rate model measures them.

    values      [N,22] their numbers
    levels      [N] int64 levels of the octree, and cells [N,3] at these
    subsets     [N] int64 which subset of the file each belongs to; None: all to one
    order       (subset, kind) of each packet; empty: that of one subset
    planes      refinements that come after the first packet of a subset
    prefixes    whether prefixes of these packets are measured too
    """

    values: Tensor
    levels: Tensor
    cells: Tensor
    subsets: Tensor | None = None
    order: Sequence[tuple[int, str]] = ()
    planes: int = 0
    prefixes: bool = False


def bits_of(values: Tensor, forecast: Forecast, last: int | None = None) -> Tensor:
    """Return the bits [N,22] of the bins around drawn values [N,22], or of the last rows alone; differentiable."""
    if fit_kernels(values, *forecast):
        return fast_bits_of(values, forecast, last)
    if last is not None:
        values, forecast = values[-last:], Forecast(*(each[-last:] for each in forecast))
    return bits(values - forecast.mean, sigma_of(forecast.scale, forecast.steps), forecast.steps)


@functools.cache
def _costs(device: torch.device) -> Tensor:
    """[511,64]: bits of indices -255..255 under each table."""
    indices = np.arange(-WINDOW, WINDOW + 1)
    return torch.from_numpy(index_bits(np.arange(TABLES)[None], indices[:, None])).float().to(device)


class StaticRate(nn.Module):
    """Means and tables by level; no parameters, `measure` sets them. What its methods are for: `PyramidRate`.

    base_steps      [22] float64 quantiser steps
    row             [16] int64: which row of the next two serves levels 3..18
    means           [16,22] int64 in base steps, 12 fractional bits
    tables          [16,22] int64, 0..63
    """

    CONTEXT = ("levels",)

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

    def begin(self, splats: Placed) -> dict[str, Tensor]:
        return self.measure(splats, ())

    def fit(
        self, context: tuple[Tensor, ...], values: Tensor, rounding: Rounding, updates: int, weights: Tensor | None
    ) -> None:
        """Do nothing: `measure` finds what is best."""

    def adapt(self) -> None:
        """Do nothing: steps are the base steps."""

    @torch.no_grad()
    def measure(self, splats: Placed, context: tuple[Tensor, ...], *, fixed: bool = False) -> dict[str, Tensor]:
        """Take the means, and for each the table of fewest bits."""
        if fixed:
            return {}
        values, levels = splats.values, splats.levels
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
        spent = found.view(LEVELS, NUMBERS, -1).float() @ _costs(values.device)  # [16,22,64]
        self.tables.copy_(spent.argmin(dim=2))
        return {}

    def predict(self, context: tuple[Tensor, ...], values: Tensor, rounding: Rounding) -> tuple[Forecast, Tensor]:
        (levels,) = context
        row = self.row[levels - LOWEST_LEVEL]
        means = (self.means * (self.base_steps / UNIT)).float()[row]
        steps = self.base_steps.float().expand(len(levels), NUMBERS)
        drawn = rounding.drawn(values, means, steps, rounding.noise(values))
        return Forecast(means, self.tables.float()[row], steps), drawn

    def round_weights(self) -> None:
        """Do nothing: there are no weights."""

    def exact(self) -> StaticContext:
        used, row = torch.unique(self.row, return_inverse=True)
        means, tables = self.means[used].cpu().numpy(), self.tables[used].cpu().numpy()
        return StaticContext(row.cpu().numpy(), means, tables, np.full(NUMBERS, UNIT, np.int64))


class PyramidRate(nn.Module):
    """Networks on running means of the splats before (`sw_wisp.context`), whose features are rows of the model.

    steps       [22] quantiser steps to begin with; the networks count in those of `sw_wisp.numbers`
    adaptive    whether steps follow the networks, from `adapt` on
    CONTEXT     rows of the model that it predicts from
    """

    CONTEXT = ("features", "view_features")
    OF_PREFIXES = "prefix_features"

    def __init__(
        self, steps: Tensor, *, adaptive: bool, size: str = "large", generator: torch.Generator | None = None
    ) -> None:
        super().__init__()
        self.adaptive, self.adapts = adaptive, False
        self.networks = ContextNetworks(size=size, generator=generator)
        places = [
            (steps / self.networks.base_steps)[block].clamp(LEAST_MULTIPLIER, MOST_MULTIPLIER) for block in BLOCKS
        ]
        self._multipliers = [
            [float(place[groups.index(group)]) for group in range(max(groups) + 1)]
            for place, groups in zip(places, STEPS_OF, strict=True)
        ]

    @property
    def base_steps(self) -> Tensor:
        return self.networks.base_steps

    @torch.no_grad()
    def begin(self, splats: Placed) -> dict[str, Tensor]:
        """Start from these splats, whose running means it predicts; return rows of the model to predict from."""
        units = splats.values / self.base_steps
        self.networks.measure_prior(units)
        features = self._features(splats, units, (units - self.networks.prior / UNIT).round(), torch.ones_like(units))
        self.networks.start(*features[: len(self.CONTEXT)], units)
        self._set_steps()
        return dict(zip((*self.CONTEXT, self.OF_PREFIXES), features, strict=False))

    def _set_steps(self) -> None:
        """Make the steps those to begin with, deviations as they are."""
        for network, multipliers, groups in zip(self.networks.networks, self._multipliers, STEPS_OF, strict=True):
            last, width = network[-1], len(groups)  # type: ignore[index]
            chosen = last.bias.new_tensor(multipliers)
            last.bias[2 * width :] = torch.atanh(chosen - 1)
            sigma = sigma_of(last.bias[width : 2 * width], 1.0)  # as if the multipliers were 1
            last.bias[width : 2 * width] = level_of(sigma, chosen[groups])

    @torch.enable_grad()
    def fit(
        self, context: tuple[Tensor, ...], values: Tensor, rounding: Rounding, updates: int, weights: Tensor | None
    ) -> None:
        """Learn to code values [N,22], drawn by `rounding`, in few bits without pictures: Adam on some splats each.

        weights     [N,22] bits that a squared unit of error of a number is worth: steps follow these; None: they stay
        """
        optimizer = torch.optim.Adam(self.networks.parameters(), lr=FIT_LR, fused=True)
        for update in range(updates):
            optimizer.param_groups[0]["lr"] = FIT_LR * LAST_FIT_LR ** (update / updates)
            rows = torch.randint(len(values), (min(FIT_BATCH, len(values)),), device=values.device)
            known = tuple(each[rows] for each in context)
            forecast, drawn = self._predict(known, values[rows], rounding, weights is not None)
            cost = bits_of(drawn, forecast).sum(1)
            if weights is not None:
                cost = cost + (weights[rows] * forecast.steps.square()).sum(1) / 12
            optimizer.zero_grad()
            cost.mean().backward()
            optimizer.step()

    def adapt(self) -> None:
        """Let gradients move the steps from here on, if they are to."""
        self.adapts = self.adaptive

    @torch.no_grad()
    def measure(self, splats: Placed, context: tuple[Tensor, ...], *, fixed: bool = False) -> dict[str, Tensor]:
        """Walk through the splats as a file would hold them now; return rows of the model that are new, by name.

        fixed       their numbers are those of the file, and what it holds of the rate model stays
        """
        forecast, drawn = self._predict(context, splats.values, AS_THEY_ARE if fixed else Rounding(HARD), True)
        indices = ((drawn - forecast.mean) / forecast.steps).round()
        steps = forecast.steps / self.base_steps
        names = (*self.CONTEXT, self.OF_PREFIXES)
        return dict(zip(names, self._features(splats, drawn / self.base_steps, indices, steps), strict=False))

    def _features(self, splats: Placed, units: Tensor, indices: Tensor, steps: Tensor) -> tuple[Tensor, ...]:
        return walked_features(
            self.networks.prior, splats.levels, splats.cells, units, indices, labels=splats.subsets,
            order=splats.order or None, planes=splats.planes, multipliers=steps, prefixes=splats.prefixes,
            make=pyramid_of,
        )  # fmt: skip

    def predict(self, context: tuple[Tensor, ...], values: Tensor, rounding: Rounding) -> tuple[Forecast, Tensor]:
        """Return distributions of values [N,22], and the values as they are drawn under these; differentiable."""
        return self._predict(context, values, rounding, self.adapts)

    def _predict(
        self, context: tuple[Tensor, ...], values: Tensor, rounding: Rounding, moves_steps: bool
    ) -> tuple[Forecast, Tensor]:
        predict = partial(predicted, self.networks) if fit_kernels(values, *context) else self.networks
        found: tuple[Forecast, Tensor] = predict(*context, values, rounding, moves_steps=moves_steps)
        return found

    def round_weights(self) -> None:
        """Compute with the weights of the file, of eight bits, from here on."""
        self.networks.rounds = True

    def exact(self) -> PyramidContext:
        """Return the same distributions in the integers of the file."""
        return self.networks.exact()
