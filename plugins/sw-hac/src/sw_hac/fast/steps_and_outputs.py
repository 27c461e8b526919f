"""Steps of all anchors and outputs for a sample as one node: the wide layer is computed for the sample alone.

All anchors that a view sees need their quantiser steps; distributions are for those whose bits are counted.
"""

from __future__ import annotations

from typing import Any

import torch
from sw_anchors.fast.kernels import fit_kernels
from sw_anchors.fast.predicted_steps import slopes_by_kernel, steps_by_kernel, steps_by_torch, steps_fit_kernel
from sw_anchors.fast.rows import add_rows, gathered
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from sw_hac.config import SMALLEST_STEP

OFFSET = 1.0
"""A step is its base times OFFSET + tanh(t), at least SMALLEST_STEP (`rate_model.steps_of`)."""


def fits(features: Tensor) -> bool:
    """Whether features [V,I] are float32 of a device with kernels; loads these."""
    return fit_kernels(features)


def steps_and_outputs(
    features: Tensor, network: nn.Sequential, base: Tensor, sample: Tensor | slice, start: int
) -> tuple[Tensor, Tensor, Tensor]:
    """As `rate_model.steps_and_outputs`."""
    first, _, last = network
    found: tuple[Tensor, Tensor, Tensor] = _StepsAndOutputs.apply(  # type: ignore[no-untyped-call]
        features, first.weight, first.bias, last.weight, last.bias, base, sample, slice(start, start + 3)
    )
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
        sample: Tensor | slice,
        part: slice,
    ) -> tuple[Tensor, Tensor, Tensor]:
        features, *parameters, base = (
            t.contiguous() for t in (features, first, first_bias, last[part], last_bias[part], base)
        )
        by_kernel = steps_fit_kernel(features, *parameters, base)
        form = steps_by_kernel if by_kernel else steps_by_torch
        steps, hidden, tangents = form(features, parameters, base, OFFSET, SMALLEST_STEP)
        rows = None if isinstance(sample, slice) else sample
        own, of_sample = (hidden[sample], steps[sample].clone()) if rows is None else gathered(rows, (hidden, steps))
        ctx.save_for_backward(features, first, first_bias, last, last_bias, base, hidden, tangents, own, rows)
        ctx.sample, ctx.part, ctx.by_kernel = sample, part, by_kernel
        return steps, of_sample, torch.addmm(last_bias, own, last.t())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_steps: Tensor, to_own: Tensor, to_outputs: Tensor) -> tuple[Tensor | None, ...]:
        features, first, first_bias, last, last_bias, base, hidden, tangents, own, rows = ctx.saved_tensors
        part = ctx.part
        to_last, to_last_bias = torch.mm(to_outputs.t(), own), to_outputs.sum(dim=0)
        to_steps, to_wide = to_steps.clone(), torch.mm(to_outputs, last)
        if rows is None:
            to_steps[ctx.sample] += to_own
        else:
            add_rows(rows, [to_own], [to_steps])
        if ctx.by_kernel:
            to_hidden = torch.zeros_like(hidden)
            to_hidden[ctx.sample if rows is None else rows] = to_wide
            parameters = [t.contiguous() for t in (first, first_bias, last[part], last_bias[part])]
            to_features, to_first, to_first_bias, *of_steps = slopes_by_kernel(
                features, parameters, base, OFFSET, SMALLEST_STEP, hidden, tangents, to_steps.contiguous(), to_hidden
            )
            to_last[part] += of_steps[0]
            to_last_bias[part] += of_steps[1]
        else:
            to_tangents = torch.ops.aten.tanh_backward(to_steps * base, tangents)
            to_tangents *= tangents >= SMALLEST_STEP - OFFSET
            to_hidden = torch.mm(to_tangents, last[part])
            if rows is None:
                to_hidden[ctx.sample] += to_wide
            else:
                add_rows(rows, [to_wide], [to_hidden])
            torch.ops.aten.threshold_backward.grad_input(to_hidden, hidden, 0, grad_input=to_hidden)
            to_last[part].addmm_(to_tangents.t(), hidden)
            to_last_bias[part] += to_tangents.sum(dim=0)
            to_features, to_first = torch.mm(to_hidden, first), torch.mm(to_hidden.t(), features)
            to_first_bias = to_hidden.sum(dim=0)
        return to_features, to_first, to_first_bias, to_last, to_last_bias, None, None, None
