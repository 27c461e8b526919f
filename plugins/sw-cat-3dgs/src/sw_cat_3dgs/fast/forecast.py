"""Forecast of a training step from kept sites on the planes: all steps, but distributions of the sample alone.

Plain form: `CatAnchors.predict` of all visible anchors, then `CatAnchors.refine` of the sample.
"""

from __future__ import annotations

import torch
from sw_anchors.anchors import linear_layers
from sw_anchors.fast.predicted_steps import predicted_steps
from sw_anchors.forecasts import AnchorForecast
from torch import Tensor, nn

from sw_cat_3dgs.context import PLANES, STEP_OFFSET, CatContext
from sw_cat_3dgs.fast.plane_sites import PlaneSites, sample


def forecast(context: CatContext, sites: PlaneSites, base_steps: Tensor) -> AnchorForecast:
    """Predict for training: V anchors at `sites` of the triplane; base_steps [3] of the shape.

    All anchors have noise of their own steps; means and scales are computed for the sample alone.
    """
    first, last = linear_layers(context.network)
    widths = context.shape.outputs[:-1]
    weights = torch.split(last.weight, [sum(widths), PLANES])
    biases = torch.split(last.bias, [sum(widths), PLANES])
    features = sample(list(context.triplane.planes), sites, rounded=context.rounded)
    parameters = (first.weight, first.bias, weights[1], biases[1])
    steps, hidden = predicted_steps(features, parameters, base_steps, offset=STEP_OFFSET)

    def of_sample(drawn: Tensor, hidden: Tensor | None, values: Tensor) -> tuple[Tensor, Tensor]:
        assert hidden is not None
        out = torch.split(nn.functional.linear(hidden, weights[0], biases[0]), widths, dim=1)
        if context.in_steps:
            units = (unit for unit in context.units for _ in (0, 1))
            out = tuple(part * unit for part, unit in zip(out, units, strict=True))
        means, scales = context.refined(out[0::2], out[1::2], values[:, : context.shape.features])
        return torch.cat(means, dim=1), torch.cat(scales, dim=1)

    return AnchorForecast(steps, None, hidden, of_sample)
