"""Forecast of a training step from kept sites on the planes: all steps, but distributions of the sample alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_anchors.anchors import linear_layers
from sw_anchors.fast.predicted_steps import predicted_steps
from sw_anchors.fast.rows import take_rows
from sw_anchors.rate_model import AnchorForecast, RateInputs, Rows
from sw_anchors.shape import GROUPS
from torch import Tensor, nn

from sw_cat_3dgs.fast.plane_sites import PlaneSites, sample

if TYPE_CHECKING:
    from sw_cat_3dgs.context import CatContext


def fits(rows: RateInputs) -> bool:
    """Whether the rows are sites on the planes."""
    return len(rows) == len(PlaneSites._fields)


def forecast(context: CatContext, base: Tensor, rows: RateInputs, drawn: Rows) -> AnchorForecast:
    """As `rate_model.forecast`, for rows that are PlaneSites."""
    first, last = linear_layers(context.network)
    sizes = [sum(context.shape.outputs[:-1]), len(GROUPS)]
    weights, biases = torch.split(last.weight, sizes), torch.split(last.bias, sizes)
    features = sample(list(context.triplane.planes), PlaneSites(*rows), rounded=context.rounded)
    parameters = (first.weight, first.bias, weights[1], biases[1])
    steps, hidden = predicted_steps(features, parameters, base, offset=context.step_offset)
    sampled = drawn if isinstance(drawn, Tensor) else torch.arange(len(steps), device=steps.device)[drawn]
    sample_steps, own = take_rows(sampled, steps, hidden)
    return AnchorForecast(steps, sample_steps, nn.functional.linear(own, weights[0], biases[0]))
