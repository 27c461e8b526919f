"""Network of two layers whose outputs are steps for all anchors, and everything for the last of them: one node.

Of the anchors that a view sees only the quantiser steps are needed; those of a sample of all are behind them, and have
distributions too. So the wide layer is computed for the sample alone, and no gradient is zeros for most rows.
"""

from __future__ import annotations

from typing import Any

import torch
from sw_anchors.fast.predicted_steps import steps_by_torch, steps_fit_kernel
from torch import Tensor
from torch.autograd.function import once_differentiable

Parameters = tuple[Tensor, Tensor, Tensor, Tensor]


def steps_and_outputs(
    features: Tensor, parameters: Parameters, base: Tensor, *, part: slice, start: int, offset: float, smallest: float
) -> tuple[Tensor, Tensor]:
    """(steps [V,3], outputs [V - start, O] of the rows from `start` on) from features [V,I]; differentiable.

    parameters  weight [H,I] and bias [H] of the layer with ReLU, weight [O,H] and bias [O] of the last one
    part        the three of the O outputs that steps are made of
    base        [3]: a step is base max(offset + tanh(t), smallest)
    """
    found: tuple[Tensor, Tensor] = _StepsAndOutputs.apply(features, *parameters, base, part, start, offset, smallest)  # type: ignore[no-untyped-call]
    return found


class _StepsAndOutputs(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        features: Tensor,
        first: Tensor,
        first_bias: Tensor,
        last: Tensor,
        last_bias: Tensor,
        base: Tensor,
        part: slice,
        start: int,
        offset: float,
        smallest: float,
    ) -> tuple[Tensor, Tensor]:
        features, *parameters, base = (
            t.contiguous() for t in (features, first, first_bias, last[part], last_bias[part], base)
        )
        ctx.bounds, ctx.part, ctx.start = (offset, smallest), part, start
        ctx.by_kernel = steps_fit_kernel(features, *parameters, base)
        form = torch.ops.sw_anchors.predicted_steps if ctx.by_kernel else steps_by_torch
        steps, hidden, tangents = form(features, parameters, base, offset, smallest)
        ctx.save_for_backward(features, first, first_bias, last, last_bias, base, hidden, tangents)
        return steps, torch.addmm(last_bias, hidden[start:], last.t())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_steps: Tensor, to_outputs: Tensor) -> tuple[Tensor | None, ...]:
        features, first, first_bias, last, last_bias, base, hidden, tangents = ctx.saved_tensors
        (offset, smallest), part, start = ctx.bounds, ctx.part, ctx.start
        to_last, to_last_bias = torch.mm(to_outputs.t(), hidden[start:]), to_outputs.sum(dim=0)
        if ctx.by_kernel:
            to_hidden = torch.empty_like(hidden)
            to_hidden[:start] = 0
            torch.mm(to_outputs, last, out=to_hidden[start:])
            parameters = [t.contiguous() for t in (first, first_bias, last[part], last_bias[part])]
            to_features, to_first, to_first_bias, *of_steps = torch.ops.sw_anchors.predicted_steps_backward(
                features, parameters, base, offset, smallest, hidden, tangents, to_steps.contiguous(), to_hidden
            )
            to_last[part] += of_steps[0]
            to_last_bias[part] += of_steps[1]
        else:
            to_tangents = torch.ops.aten.tanh_backward(to_steps * base, tangents)
            to_tangents *= tangents >= smallest - offset
            to_hidden = torch.mm(to_tangents, last[part])
            to_hidden[start:].addmm_(to_outputs, last)
            torch.ops.aten.threshold_backward.grad_input(to_hidden, hidden, 0, grad_input=to_hidden)
            to_last[part].addmm_(to_tangents.t(), hidden)
            to_last_bias[part] += to_tangents.sum(dim=0)
            to_features, to_first = torch.mm(to_hidden, first), torch.mm(to_hidden.t(), features)
            to_first_bias = to_hidden.sum(dim=0)
        return to_features, to_first, to_first_bias, to_last, to_last_bias, None, None, None, None, None
