"""`rates.gaussian_bits` as one node of the graph of derivatives: a third of the operators."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled


def fits(x: Tensor, mu: Any, sigma: Any, step: Any) -> bool:
    """Whether all are tensors, x and mu of one type."""
    return fast_enabled() and all(isinstance(each, Tensor) for each in (mu, sigma, step)) and mu.dtype == x.dtype


def gaussian_bits(x: Tensor, mu: Any, sigma: Any, step: Any, *, p_min: float, grad_below_bound: bool = True) -> Tensor:
    """As `rates.gaussian_bits`, where it `fits`."""
    found: Tensor = _GaussianBits.apply(x, mu, sigma, step, p_min, grad_below_bound)  # type: ignore[no-untyped-call]
    return found


class _GaussianBits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, mu: Tensor, sigma: Tensor, step: Tensor, p_min: float, grad_below: bool) -> Tensor:
        offset = x - mu
        away, half = offset.abs(), step / 2
        scale = (sigma * math.sqrt(2)).reciprocal_()
        near, far = (away - half) * scale, (away + half) * scale
        p = (torch.erfc(near) - torch.erfc(far)).mul_(0.5)
        ctx.save_for_backward(offset, sigma, scale, near, far, p)
        ctx.shapes = x.shape, mu.shape, sigma.shape, step.shape
        ctx.bound, ctx.grad_below = p_min, grad_below
        return p.clamp_min(p_min).log2_().neg_()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        offset, sigma, scale, near, far, p = ctx.saved_tensors
        slope = grad / (p.clamp_min(ctx.bound) * (-math.log(2)))
        passes = p >= ctx.bound
        if ctx.grad_below:
            passes = passes | (slope < 0)  # as in `lower_bound`
        slope = slope * passes * (1 / math.sqrt(math.pi))
        at_near, at_far = slope * torch.exp(-near * near), slope * torch.exp(-far * far)
        inner = (at_far - at_near) * scale  # of the distance to the mean
        found: list[Tensor | None] = [None] * 4
        if ctx.needs_input_grad[0] or ctx.needs_input_grad[1]:
            to_symbol = inner * offset.sign()
            found[:2] = to_symbol, -to_symbol
        if ctx.needs_input_grad[2]:
            found[2] = (at_near * near - at_far * far) / sigma
        if ctx.needs_input_grad[3]:
            found[3] = (at_near + at_far) * scale / 2
        return *(None if g is None else g.sum_to_size(s) for g, s in zip(found, ctx.shapes, strict=True)), None, None
