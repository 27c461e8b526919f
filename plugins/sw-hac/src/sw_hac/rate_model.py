"""The rate model of HAC: a binary hash grid over the box of the anchors, and a network that reads it.

For an anchor at u in [0,1]^3 the network gives mean and deviation of its F features, 6 scales and 3k coordinates of
offsets (`read`), and a logit t of each group, whose quantiser step is Q0 (1 + tanh t) (`steps_of`); Q0 = 1, 0.001 and
0.2 as published. A number x costs the bits of the bin [x - step/2, x + step/2] under its Gaussian (`bits`). Training
(`forecast`, `rate`) and the file (`exact`, `floats`) use one object. Source: HAC (arXiv 2403.14530), sections 4.2, 4.3.

`forecast` and `rate` take the forms of `fast` where there are kernels: whoever changes `steps_and_outputs` or `bits`
sees it with SW_FAST=0, or with a method `rate` of their own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.float_mode import Mode, one_thread
from sw_anchors.lattice import TOP
from sw_anchors.rate_model import (
    PUBLISHED_FLOORS,
    AnchorDistributions,
    AnchorForecast,
    Floors,
    RateInputs,
    Rows,
    gaussian_rate,
    triple,
)
from sw_anchors.row_parts import MAX_FLOAT_NUMBERS, by_parts
from sw_anchors.shape import GROUPS, AnchorShape
from torch import Tensor, nn

from sw_codecs.entropy.rows import RowContext, RowLattice
from sw_hac.config import SMALLEST_STEP
from sw_hac.fast import predicted_bits
from sw_hac.fast import steps_and_outputs as fast_outputs
from sw_hac.mixed_grid import MixedHashGrid

BlockPrediction = Mapping[str, tuple[RowContext | RowLattice, Tensor]]
"""Distributions of a block of n anchors by group, with their quantiser steps [n,1] float64 in units of the values."""


@dataclass(frozen=True)
class HACRateModel:
    """Grid and network as one rate model, see `sw_anchors.rate_model.RateModel`; contexts are places u [V,3] in 0..1.

    grid        binary hash grid over the box of the anchors
    network     from its features to W outputs: those of `shape.outputs`, then any that a subclass reads
    shape       how many numbers an anchor has, by group
    base_steps  quantiser steps Q0 of features, scales and offsets, which the predicted ones multiply
    base        [3] the same as a tensor, on the device of the network
    units       [W] factors of the outputs; None: 1, as in a file
    floors      smallest probability of a number and smallest deviation, in training
    """

    grid: MixedHashGrid
    network: nn.Sequential
    shape: AnchorShape
    base_steps: tuple[float, float, float]
    base: Tensor
    units: Tensor | None = None
    floors: Floors = PUBLISHED_FLOORS

    @classmethod
    def of_file(
        cls, grid: MixedHashGrid, network: nn.Sequential, shape: AnchorShape, base_steps: tuple[float, float, float]
    ) -> HACRateModel:
        """Return the rate model that a file holds, on the CPU."""
        return cls(grid, network, shape, base_steps, torch.tensor(base_steps))

    # Training

    @property
    def distributions(self) -> int:
        """Number of outputs before the step logits: a mean and a deviation for each number of an anchor."""
        return sum(self.shape.outputs[:-1])

    def forecast(self, inputs: RateInputs, sample: Rows) -> AnchorForecast:
        """Predict the steps of all anchors at places [V,3], and for the rows `sample` the outputs that `rate` reads.

        `own_bits` of the forecast are those of the grid.
        """
        (places,) = inputs
        features, bits = self.grid.with_bits(places)
        compute = fast_outputs.steps_and_outputs if fast_outputs.fits(features) else steps_and_outputs
        steps, sample_steps, outputs = compute(features, self.network, self.base, sample, self.distributions)
        return AnchorForecast(steps, sample_steps, outputs, bits)

    def rate(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of noisy values [S,C], by kernels where there are some; see `bits`."""
        count = predicted_bits.rate if predicted_bits.fits(values, forecast, masks, counted) else HACRateModel.bits
        return count(self, values, forecast, masks, counted)

    def bits(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of noisy values [S,C], each under its own Gaussian.

        masks       [S,k] factors of the bits of an offset, 0 or 1
        counted     [S] factors of the bits of all other numbers, 1 where the anchor counts

        Returns (sum, differentiable; sums by group [3]).
        """
        found = self.read(forecast.outputs)
        mean, scale = torch.cat(found.means, dim=1), torch.cat(found.scales, dim=1)
        return gaussian_rate(values, mean, scale, forecast.sample_steps, masks, counted, self.floors)

    def read(self, outputs: Tensor) -> AnchorDistributions:
        """Read outputs [V,W] of the network as means and deviations [V,C] and steps [V,1] of each group."""
        outputs = outputs if self.units is None else outputs * self.units
        parts = torch.split(outputs[:, : sum(self.shape.outputs)], self.shape.outputs, dim=1)
        steps = steps_of(parts[6], self.base)
        return AnchorDistributions(triple(parts[0:6:2]), triple(parts[1:6:2]), triple(steps.split(1, dim=1)))

    # File

    @property
    def row_width(self) -> int:
        """Largest number of values that one place needs while it is looked up: features, or corners of all cells."""
        return max(self.grid.width, self.grid.corners)

    def short_features(self, codes: Tensor) -> Tensor:
        """Return the features [n,width] of position codes [n,3] as int16, which the integer network takes fastest."""
        return self.grid.integer_features(codes, torch.int16)

    def exact(self) -> Predictor:
        """Return the rate model evaluated in integers. Raises ValueError if the network cannot be."""
        return ExactPredictor(self)

    def floats(self) -> Predictor:
        """Return the rate model evaluated in floats, as trained, for comparison with published sizes."""
        return FloatPredictor(self)

    def predictor(self, mode: Mode) -> Predictor:
        """Return the form that predicts in a file of this mode."""
        return self.exact() if mode == "exact" else self.floats()


def steps_and_outputs(
    features: Tensor, network: nn.Sequential, base: Tensor, sample: Rows, start: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Predict steps [V,3] from features [V,I]; return them, those of the rows `sample` [S,3], and their outputs [S,W].

    base    [3] base steps
    start   first of the three step logits among the W outputs
    """
    outputs: Tensor = network(features)
    steps = steps_of(outputs[:, start : start + 3], base)
    return steps, steps[sample], outputs[sample]


def steps_of(logits: Tensor, base: Tensor) -> Tensor:
    """Return the quantiser steps base (1 + tanh t) for logits t [V,3], in base/64 .. 2 base; differentiable.

    Paper: down to 0. The file takes them from a table of 128 (`sw_codecs.entropy.exact_tables.step_multipliers`).
    """
    return base * (1 + torch.tanh(logits)).clamp(min=SMALLEST_STEP)


class ExactPredictor:
    """A HACRateModel in integers with 12 fractional bits, the same on every machine."""

    def __init__(self, model: HACRateModel) -> None:
        self._model, self._network = model, ExactNetwork(model.network, model.shape, model.base_steps)

    def __call__(self, codes: Tensor) -> BlockPrediction:
        """Predict for anchors at position codes [n,3] on the lattice; means and deviations in base steps."""
        found = self._network.on_lattice(codes, self._model.short_features, self._model.row_width)
        return {
            group: (distributions, self._network.steps(group, distributions)) for group, distributions in found.items()
        }


class FloatPredictor:
    """A HACRateModel in floats, as trained: its files are bound to one machine."""

    def __init__(self, model: HACRateModel) -> None:
        self._model = model

    def __call__(self, codes: Tensor) -> BlockPrediction:
        """Predict for anchors at position codes [n,3] on the lattice; means and deviations in units of the values."""
        return float_prediction(self._model.read(float_outputs(self._model, codes)))


Predictor = ExactPredictor | FloatPredictor


def float_outputs(model: HACRateModel, codes: Tensor) -> Tensor:
    """Return outputs [n,W] of the network for anchors at position codes [n,3] on the lattice, in one thread."""
    width = max(model.row_width, model.network[0].out_features)
    with one_thread():
        return by_parts(
            lambda part: model.network(model.grid(part.to(torch.float32) / TOP)), codes, width, MAX_FLOAT_NUMBERS
        )


def float_prediction(found: AnchorDistributions) -> dict[str, tuple[RowContext | RowLattice, Tensor]]:
    """Return distributions as `conditional-gaussian` takes them in mode `float`; deviations are at least 1e-9."""
    return {
        group: (RowContext(mean.clamp(-1e6, 1e6), scale.clamp(1e-9, 1e6), step.double()), step.double())
        for group, mean, scale, step in zip(GROUPS, found.means, found.scales, found.steps, strict=True)
    }
