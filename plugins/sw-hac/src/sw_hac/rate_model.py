"""The rate model of HAC: a binary hash grid over the box of the anchors, and a network that reads it.

For an anchor at u in [0,1]^3 the network gives mean and deviation of its F features, 6 scales and 3k coordinates of
offsets, and one number t per group, whose quantiser step is Q0 (1 + tanh t); Q0 = 1, 0.001 and 0.2 as published. What
training counts (`forecast`, `rate`) and what the file is coded with (`exact`, `floats`) come from one object.
Source: HAC (arXiv 2403.14530), sections 4.2 and 4.3.
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
    AnchorContext,
    AnchorForecast,
    Context,
    Floors,
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
"""Group -> its distributions for a block of n anchors, and quantiser steps [n,1] float64 in units of the values."""


@dataclass(frozen=True)
class HACRateModel:
    """Grid and network as one rate model, see `sw_anchors.rate_model.RateModel`; contexts are places u [V,3].

    grid        hash grid over the box of the anchors, signs
    network     from its features to the outputs of `shape` (and any others)
    shape       numbers of an anchor
    base        [3] steps Q0 before they are predicted, on the device of the network
    units       [W] factors of the outputs; None: 1, as in a file
    floors      of the rate in training
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
        """Outputs of the network before the step logits."""
        return sum(self.shape.outputs[:-1])

    def forecast(self, context: Context, sample: Rows) -> AnchorForecast:
        """Predict the steps of all anchors at places [V,3], and the outputs of the network for the rows `sample`."""
        (places,) = context
        features, bits = self.grid.with_bits(places)
        predict = fast_outputs.steps_and_outputs if fast_outputs.fits(features) else steps_and_outputs
        steps, sample_steps, outputs = predict(features, self.network, self.base, sample, self.distributions)
        return AnchorForecast(steps, sample_steps, outputs, bits)

    def rate(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of noisy values [S,C]; those of a masked offset are multiplied by its mask."""
        count = predicted_bits.rate if predicted_bits.fits(values, forecast, masks, counted) else HACRateModel.bits
        return count(self, values, forecast, masks, counted)

    def bits(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of each number under its own Gaussian."""
        found = self.read(forecast.outputs)
        mean, scale = torch.cat(found.means, dim=1), torch.cat(found.scales, dim=1)
        return gaussian_rate(values, mean, scale, forecast.sample_steps, masks, counted, self.floors)

    def read(self, outputs: Tensor) -> AnchorContext:
        """Read outputs [V, W] of the network as means, deviations and steps."""
        outputs = outputs if self.units is None else outputs * self.units
        parts = torch.split(outputs[:, : sum(self.shape.outputs)], self.shape.outputs, dim=1)
        steps = steps_of(parts[6], self.base)
        return AnchorContext(triple(parts[0:6:2]), triple(parts[1:6:2]), triple(steps.split(1, dim=1)))

    def predict(self, places: Tensor) -> AnchorContext:
        """Predict for anchors at places [V,3]; differentiable."""
        return self.read(self.network(self.grid(places)))

    # File

    @property
    def row_width(self) -> int:
        """The most numbers that one place has while it is looked up: features, or corners of all cells."""
        return max(self.grid.width, self.grid.corners)

    def short_features(self, codes: Tensor) -> Tensor:
        """Features of codes [n,3] as the integer network takes them fastest."""
        return self.grid.integer_features(codes, torch.int16)

    def exact(self) -> Predictor:
        """Return the rate model evaluated in integers. Raises ValueError if the network cannot be."""
        return ExactPredictor(self)

    def floats(self) -> Predictor:
        """Return the rate model evaluated in floats, as trained, for comparison with published sizes."""
        return FloatPredictor(self)

    def predictor(self, mode: Mode) -> Predictor:
        """Return what a file of this mode is coded with."""
        return self.exact() if mode == "exact" else self.floats()


def steps_and_outputs(
    features: Tensor, network: nn.Sequential, base: Tensor, sample: Rows, start: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (steps [V,3], those of the rows `sample` [S,3], outputs [S,W] of these) from features [V,I].

    start   the step logits are three of the W outputs from here on
    """
    outputs: Tensor = network(features)
    steps = steps_of(outputs[:, start : start + 3], base)
    return steps, steps[sample], outputs[sample]


def steps_of(logits: Tensor, base: Tensor) -> Tensor:
    """Return quantiser steps [V,3] for logits t [V,3]: base (1 + tanh t), at least SMALLEST_STEP of it."""
    return base * (1 + torch.tanh(logits)).clamp(min=SMALLEST_STEP)


class ExactPredictor:
    """A HACRateModel in integers with 12 fractional bits, the same on every machine."""

    def __init__(self, model: HACRateModel) -> None:
        self._model, self._network = model, ExactNetwork(model.network, model.shape, model.base_steps)

    def __call__(self, codes: Tensor) -> BlockPrediction:
        """Predict for anchors at `codes` [n,3] on the lattice."""
        found = self._network.on_lattice(codes, self._model.short_features, self._model.row_width)
        return {group: (context, self._network.steps(group, context)) for group, context in found.items()}


class FloatPredictor:
    """A HACRateModel in floats."""

    def __init__(self, model: HACRateModel) -> None:
        self._model = model

    def __call__(self, codes: Tensor) -> BlockPrediction:
        """Predict for anchors at `codes` [n,3] on the lattice."""
        return float_prediction(self._model.read(float_outputs(self._model, codes)))


Predictor = ExactPredictor | FloatPredictor


def float_outputs(model: HACRateModel, codes: Tensor) -> Tensor:
    """Return outputs [n,W] of the network for anchors at `codes` [n,3] of the lattice, in one thread."""
    width = max(model.row_width, model.network[0].out_features)
    with one_thread():
        return by_parts(
            lambda part: model.network(model.grid(part.to(torch.float32) / TOP)), codes, width, MAX_FLOAT_NUMBERS
        )


def float_prediction(found: AnchorContext) -> dict[str, tuple[RowContext | RowLattice, Tensor]]:
    """Return distributions as the coder of floats takes them."""
    return {
        group: (RowContext(mean.clamp(-1e6, 1e6), scale.clamp(1e-9, 1e6), step.double()), step.double())
        for group, mean, scale, step in zip(GROUPS, found.means, found.scales, found.steps, strict=True)
    }
