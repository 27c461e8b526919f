"""Subclasses of `CodedAnchors` as of 0.2, which have `predict` and `refine` instead of a rate model; until 0.4."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sw_anchors import rate_model
from sw_anchors.rate_model import AnchorForecast, AnchorRate, RateInputs, Rows, Triple, gaussian_rate, triple

__all__ = ["AnchorContext", "AnchorForecast", "AnchorRate", "PredictedRate", "Triple", "triple"]


@dataclass(frozen=True)
class AnchorContext(rate_model.AnchorDistributions):
    """Prediction of `predict`, with the bits of what the context model itself stores."""

    own_bits: Tensor | None = None


class PredictedRate:
    """Rate model of a CodedAnchors that overrides `predict`; its contexts are rows of the model."""

    def __init__(self, model: Any) -> None:
        """Raises NotImplementedError for a model without `predict`."""
        if not hasattr(model, "predict"):
            raise NotImplementedError(f"{type(model).__name__} has no rate_model")
        warnings.warn(
            "CodedAnchors.predict and refine go with 0.4: give a rate_model (docs/migration.md)",
            DeprecationWarning,
            stacklevel=3,
        )
        self._model = model

    def forecast(self, inputs: RateInputs, sample: Rows) -> AnchorForecast:
        """Predict for rows of the model."""
        found = self._model.predict(*inputs)
        steps = torch.cat(found.steps, dim=1)
        outputs = torch.cat([*found.means, *found.scales], dim=1)
        return AnchorForecast(steps, steps[sample], outputs[sample], getattr(found, "own_bits", None))

    def rate(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of values [S,C] under Gaussians, which `refine` sees the features of."""
        widths = list(self._model.shape.widths)
        means, scales = (triple(half.split(widths, dim=1)) for half in forecast.outputs.chunk(2, dim=1))
        found: rate_model.AnchorDistributions = AnchorContext(
            means, scales, triple(forecast.sample_steps.split(1, dim=1))
        )
        if hasattr(self._model, "refine"):
            found = self._model.refine(found, values[:, : widths[0]])
        mean, scale = torch.cat(found.means, dim=1), torch.cat(found.scales, dim=1)
        return gaussian_rate(values, mean, scale, forecast.sample_steps, masks, counted, self._model.floors)

    def exact(self) -> object:
        """Raises NotImplementedError: the file is the method's."""
        raise NotImplementedError
