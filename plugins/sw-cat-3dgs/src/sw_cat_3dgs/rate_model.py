"""The rate model of CAT-3DGS: its context, whose slices refine each part of an anchor by the features before it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from sw_anchors.rate_model import PUBLISHED_FLOORS, AnchorForecast, Context, Floors, Rows, gaussian_rate
from torch import Tensor

from sw_cat_3dgs.context import CatContext
from sw_cat_3dgs.fast import forecast as fast_forecast
from sw_cat_3dgs.predictors import ExactPredictor


@dataclass(frozen=True)
class CatRateModel:
    """A CatContext as a rate model, see `sw_anchors.rate_model.RateModel`; contexts are places [V,3] in the triplane.

    base    [3] base steps, on the device of the context
    """

    context: CatContext
    base: Tensor
    floors: Floors = PUBLISHED_FLOORS

    def forecast(self, rows: Context, sample: Rows) -> AnchorForecast:
        """Predict the steps of all anchors, and the outputs of the network for the rows `sample`."""
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


def forecast(context: CatContext, base: Tensor, rows: Context, sample: Rows) -> AnchorForecast:
    """Predict for anchors at places [V,3] in the triplane, the first of `rows`."""
    outputs = context.outputs(rows[0])
    steps = torch.cat(context.read(outputs).steps, dim=1)
    return AnchorForecast(steps, steps[sample], outputs[sample][:, : sum(context.shape.outputs[:-1])])
