"""The rate model of CAT-3DGS: its context, whose slices refine each part of an anchor by the features before it.

What training counts (`forecast`, `rate`) and what the file is coded with come from one object: `ExactPredictor` in
integers, the same on every machine; `FloatPredictor` as trained, for comparison with published sizes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.float_mode import Mode
from sw_anchors.rate_model import PUBLISHED_FLOORS, AnchorForecast, Floors, RateInputs, Rows, gaussian_rate
from sw_anchors.row_parts import MAX_FLOAT_NUMBERS, by_parts
from sw_anchors.shape import GROUPS
from torch import Tensor

from sw_cat_3dgs.context import CatContext
from sw_cat_3dgs.fast import forecast as fast_forecast
from sw_codecs.entropy.rows import RowContext

MULTIPLIER_OFFSET = 410
"""Steps are base (1.1 + tanh t), `context.STEP_OFFSET`: in 1/4096 this is added to the table's 4096 (1 + tanh t)."""


@dataclass(frozen=True)
class CatRateModel:
    """A CatContext as a rate model, see `sw_anchors.rate_model.RateModel`; contexts are places [V,3] in the triplane.

    base    [3] base steps, on the device of the context
    """

    context: CatContext
    base: Tensor
    floors: Floors = PUBLISHED_FLOORS

    def forecast(self, rows: RateInputs, sample: Rows) -> AnchorForecast:
        """Predict the steps of all anchors, and for the rows `sample` the outputs that `read` reads."""
        predict = fast_forecast.forecast if fast_forecast.fits(rows) else forecast
        return predict(self.context, self.base, rows, sample)

    def rate(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of noisy values [S,C] under Gaussians that their own features refine."""
        mean, scale = self.read(forecast, values)
        return gaussian_rate(values, mean, scale, forecast.sample_steps, masks, counted, self.floors)

    def read(self, forecast: AnchorForecast, values: Tensor) -> tuple[Tensor, Tensor]:
        """Return means and deviations [S,C] of a sample, refined by its features among the values [S,C]."""
        shape = self.context.shape
        parts = list(torch.split(forecast.outputs, shape.outputs[:-1], dim=1))
        if self.context.in_steps:
            units = (unit for unit in self.context.units for _ in (0, 1))
            parts = [part * unit for part, unit in zip(parts, units, strict=True)]
        means, scales = self.context.refined(parts[0::2], parts[1::2], values[:, : shape.features])
        return torch.cat(means, dim=1), torch.cat(scales, dim=1)

    def exact(self) -> ExactPredictor:
        """Return the context in integers, for the file."""
        return ExactPredictor(self.context)

    def predictor(self, mode: Mode) -> Predictor:
        """Return what a file of this mode is coded with."""
        return self.exact() if mode == "exact" else FloatPredictor(self.context)

    @classmethod
    def of_file(cls, context: CatContext) -> CatRateModel:
        """Return the rate model of a context that a file holds."""
        return cls(context, torch.tensor(context.shape.base_steps))


def forecast(context: CatContext, base: Tensor, rows: RateInputs, sample: Rows) -> AnchorForecast:
    """Predict for anchors at places [V,3] in the triplane, the first of `rows`."""
    outputs = context.outputs(rows[0])
    steps = torch.cat(context.read(outputs).steps, dim=1)
    return AnchorForecast(steps, steps[sample], outputs[sample][:, : sum(context.shape.outputs[:-1])])


class ExactPredictor:
    """A CatContext in integers with 12 fractional bits: means and scales in base steps, steps as multiples of it."""

    def __init__(self, context: CatContext) -> None:
        """Raises ValueError or BitstreamError for weights that no exact evaluation takes."""
        self.context = context
        self._lookup = context.triplane.exact_lookup(context.triplane.integers())
        shape = context.shape
        self._network = ExactNetwork(context.network, shape, shape.base_steps, step_offset=MULTIPLIER_OFFSET)
        self._slices = context.slices.exact({"scales": 1 / shape.base_steps[1], "offsets": 1 / shape.base_steps[2]})

    def first(self, places: Tensor) -> dict[str, RowContext]:
        """Distributions by group that the position alone gives."""
        return self._network(places, self._lookup, self.context.triplane.width)

    def shift(self, name: str, known: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of mean and scale that the network `name` of the slices makes of the known features."""
        mean, scale = self._slices[name](known).chunk(2, dim=1)
        return mean, scale

    def known(self, symbols: Tensor, context: RowContext) -> Tensor:
        """Decoded features as the networks take them: their base step is 1."""
        multipliers: Tensor = context.step
        return symbols * multipliers

    def steps(self, group: str, context: RowContext) -> Tensor:
        """Quantiser steps in units of the values, float64."""
        return self._network.steps(group, context)


class FloatPredictor:
    """A CatContext in floats as trained, in units of the values."""

    def __init__(self, context: CatContext) -> None:
        self.context = context

    def first(self, places: Tensor) -> dict[str, RowContext]:
        """Distributions by group that the position alone gives."""
        width = max(self.context.triplane.width, self.context.shape.hidden)
        found = self.context.read(by_parts(self.context.outputs, places, width, MAX_FLOAT_NUMBERS))
        return {g: RowContext(found.means[i], found.scales[i], found.steps[i]) for i, g in enumerate(GROUPS)}

    def shift(self, name: str, known: Tensor) -> tuple[Tensor, Tensor]:
        """Changes of mean and scale that the network `name` of the slices makes of the known features."""
        network = self.context.slices.networks[name]
        mean, scale = by_parts(network, known, self.context.shape.slice_hidden, MAX_FLOAT_NUMBERS).chunk(2, dim=1)
        return mean, scale

    def known(self, symbols: Tensor, context: RowContext) -> Tensor:
        """Decoded features as the networks take them."""
        step: Tensor = context.step
        return (symbols.to(torch.float64) * step).to(torch.float32)

    def steps(self, group: str, context: RowContext) -> Tensor:
        """Quantiser steps in units of the values, float64."""
        step: Tensor = context.step
        return step.to(torch.float64)


Predictor = ExactPredictor | FloatPredictor
