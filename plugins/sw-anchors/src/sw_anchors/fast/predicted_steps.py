"""Predicted quantiser steps of all visible anchors as one autograd node, a kernel on the CPU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_anchors import face
from sw_anchors.native import ANCHORS


def predicted_steps(
    features: Tensor,
    parameters: tuple[Tensor, Tensor, Tensor, Tensor],
    base: Tensor,
    *,
    offset: float,
    smallest: float = -math.inf,
) -> tuple[Tensor, Tensor]:
    """(steps [V,3], hidden layer [V,H]) from features [V,I]; differentiable.

    parameters  weight [H,I] and bias [H] of the layer with ReLU, weight [3,H] and bias [3] of the outputs t
    base        [3]: a step is base max(offset + tanh(t), smallest)
    """
    if steps_fit_kernel(features, *parameters, base):
        found: tuple[Tensor, Tensor] = _ByKernel.apply(base, offset, smallest, features, *parameters)  # type: ignore[no-untyped-call]
        return found
    steps, hidden, _ = steps_by_torch(features, parameters, base, offset, smallest)
    return steps, hidden


def steps_fit_kernel(*tensors: Tensor) -> bool:
    """Whether there is a kernel for the steps of these tensors; loads it."""
    return all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors) and ANCHORS.try_load()


def steps_by_torch(
    features: Tensor, parameters: Sequence[Tensor], base: Tensor, offset: float, smallest: float
) -> tuple[Tensor, Tensor, Tensor]:
    """(steps [V,3], hidden layer [V,H], tanh(t) [V,3]) as the kernel `predicted_steps` finds them; differentiable."""
    weight, bias, last, last_bias = parameters
    hidden = torch.addmm(bias, features, weight.t()).relu_()
    tangents = torch.addmm(last_bias, hidden, last.t()).tanh_()
    # Not in place from here on: autograd would copy what the floor needs on its way back.
    steps = tangents + offset
    return (steps if math.isinf(smallest) else steps.clamp(min=smallest)) * base, hidden, tangents


def steps_by_kernel(
    features: Tensor, parameters: Sequence[Tensor], base: Tensor, offset: float, smallest: float
) -> tuple[Tensor, Tensor, Tensor]:
    """`steps_by_torch` of contiguous tensors that fit the kernel; not differentiable."""
    first, first_bias, last, last_bias = parameters
    steps, tangents = features.new_empty(len(features), 3), features.new_empty(len(features), 3)
    hidden = features.new_empty(len(features), len(first))
    face.predicted_steps(
        features=features, first=first, first_bias=first_bias, last=last, last_bias=last_bias, base=base,
        offset=offset, smallest=smallest, steps=steps, hidden=hidden, tangents=tangents,
    )  # fmt: skip
    return steps, hidden, tangents


def slopes_by_kernel(
    features: Tensor, parameters: Sequence[Tensor], base: Tensor, offset: float, smallest: float,
    hidden: Tensor, tangents: Tensor, by_steps: Tensor, by_hidden: Tensor,
) -> list[Tensor]:  # fmt: skip
    """Gradients of features and parameters from those of what `steps_by_kernel` returned, all contiguous."""
    first, first_bias, last, last_bias = parameters
    found = [torch.empty_like(t) for t in (features, *parameters)]
    to_features, to_first, to_first_bias, to_last, to_last_bias = found
    face.predicted_steps_backward(
        features=features, first=first, first_bias=first_bias, last=last, last_bias=last_bias, base=base,
        offset=offset, smallest=smallest, hidden=hidden, tangents=tangents, by_steps=by_steps, by_hidden=by_hidden,
        to_features=to_features, to_first=to_first, to_first_bias=to_first_bias, to_last=to_last,
        to_last_bias=to_last_bias,
    )  # fmt: skip
    return found


class _ByKernel(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, base: Tensor, offset: float, smallest: float, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        features, *parameters = (t.contiguous() for t in inputs)
        ctx.bounds = offset, smallest
        steps, hidden, tangents = steps_by_kernel(features, parameters, base, offset, smallest)
        ctx.save_for_backward(base, features, *parameters, hidden, tangents)
        return steps, hidden

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_steps: Tensor, by_hidden: Tensor) -> tuple[Tensor | None, ...]:
        base, features, *parameters, hidden, tangents = ctx.saved_tensors
        offset, smallest = ctx.bounds
        found = slopes_by_kernel(
            features,
            parameters,
            base,
            offset,
            smallest,
            hidden,
            tangents,
            by_steps.contiguous(),
            by_hidden.contiguous(),
        )
        return None, None, None, *found
