"""Forecast of a training step from kept sites on the planes: all steps, but distributions of the sample alone."""

from __future__ import annotations

import torch
from sw_anchors.anchors import linear_layers
from sw_anchors.fast.predicted_steps import predicted_steps
from sw_anchors.fast.rows import take_rows
from sw_anchors.rate_model import AnchorForecast, Context, Rows
from torch import Tensor, nn

from sw_cat_3dgs.context import PLANES, STEP_OFFSET, CatContext
from sw_cat_3dgs.fast.plane_sites import PlaneSites, sample


def fits(rows: Context) -> bool:
    """Whether the rows are sites on the planes."""
    return len(rows) == len(PlaneSites._fields)


def forecast(context: CatContext, base: Tensor, rows: Context, drawn: Rows) -> AnchorForecast:
    """As `rate_model.forecast`, for rows that are PlaneSites."""
    assert isinstance(drawn, Tensor)
    first, last = linear_layers(context.network)
    count = sum(context.shape.outputs[:-1])
    weights, biases = torch.split(last.weight, [count, PLANES]), torch.split(last.bias, [count, PLANES])
    features = sample(list(context.triplane.planes), PlaneSites(*rows), rounded=context.rounded)
    parameters = (first.weight, first.bias, weights[1], biases[1])
    steps, hidden = predicted_steps(features, parameters, base, offset=STEP_OFFSET)
    sample_steps, own = take_rows(drawn, steps, hidden)
    return AnchorForecast(steps, sample_steps, nn.functional.linear(own, weights[0], biases[0]))
