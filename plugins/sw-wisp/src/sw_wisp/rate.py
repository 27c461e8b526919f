"""Bits of numbers as training estimates them: floats that match the count tables of the file."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sw_codecs.entropy import rates

SMALLEST, RANGE, HIGHEST_LEVEL = 0.05, 1280.0, 63
"""Scale of table level 0 in steps, that of level 63 over it, and the last level."""
LEAST_PROBABILITY = 2.0**-16
"""Share of the rarest entry of a table."""


class Forecast(NamedTuple):
    """Distributions of the 22 numbers of N splats, each [N,22].

    mean    in the units of the numbers
    scale   level 0..63 of the table: linear in the logarithm of the deviation in steps
    steps   quantiser steps, in the units of the numbers
    """

    mean: Tensor
    scale: Tensor
    steps: Tensor


class _InwardClamp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, low: float, high: float) -> Tensor:
        ctx.save_for_backward(x)
        ctx.bounds = low, high
        return x.clamp(low, high)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        low, high = ctx.bounds
        returns = ((x >= low) | (grad < 0)) & ((x <= high) | (grad > 0))  # descent moves against the gradient
        return grad * returns, None, None


def inward_clamp(x: Tensor, low: float, high: float) -> Tensor:
    """x within low..high; outside, only a gradient whose descent leads back passes."""
    found: Tensor = _InwardClamp.apply(x, low, high)
    return found


def sigma_of(level: Tensor, step: Tensor | float) -> Tensor:
    """Scale for a float scale level (clamped to 0..63) and a step, in the unit of the step."""
    ratio = torch.exp(inward_clamp(level, 0.0, HIGHEST_LEVEL) * (math.log(RANGE) / HIGHEST_LEVEL))
    return step * SMALLEST * ratio


def level_of(sigma: Tensor, step: Tensor | float) -> Tensor:
    """Scale level of a scale: inverse of `sigma_of`, clamped to 0..63; no gradient beyond."""
    ratio = torch.as_tensor(sigma / step).clamp_min(1e-30)
    return (torch.log(ratio / SMALLEST) * (HIGHEST_LEVEL / math.log(RANGE))).clamp(0, HIGHEST_LEVEL)


def bits(r: Tensor, sigma: Tensor | float, step: Tensor | float) -> Tensor:
    """Bits of residuals r = z - mu (noisy or rounded) in bins of one step under N(0, sigma); shape of r.

    Differentiable in all three. A bin of less than 2^-16 costs 16 bits, and still pulls r inwards and sigma up.
    """
    return rates.gaussian_bits(r, 0.0, sigma, step, p_min=LEAST_PROBABILITY)
