"""Rate estimates for training: bits per element under Gaussians, and of masks; `further_rates` has other models.

All are differentiable in every float argument, on any device. Source: specification of the codec library, entropy
models (rate estimators).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from splatwizard_native import lazy_exports
from sw_codecs.entropy.fast import gaussian_bits as fast_bits

# Old import paths, until 0.4.
_, __getattr__ = lazy_exports(
    __name__,
    {"sw_codecs.entropy.further_rates": "laplace_mass laplace_bits mixture_bits bernoulli_bits categorical_bits"},
)

CODER_FLOOR = 2.0**-24  # the smallest probability that the range coder has


class _LowerBound(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, p: Tensor, bound: float | Tensor, grad_below: bool) -> Tensor:
        ctx.save_for_backward(p)
        ctx.bound, ctx.grad_below = bound, grad_below
        return p.clamp_min(bound)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        (p,) = ctx.saved_tensors
        passes = p >= ctx.bound
        if ctx.grad_below:
            passes = passes | (grad < 0)  # descent would raise p: let it
        return grad * passes, None, None


def lower_bound(p: Tensor, bound: float | Tensor, *, grad_below_bound: bool = True) -> Tensor:
    """max(p, bound); the gradient also passes below the bound where descent would raise p.

    bound               a number, or one for each of p; it gets no gradient
    grad_below_bound    False: no gradient below the bound (what HAC's public code does; for parity runs)
    """
    return _LowerBound.apply(p, bound, grad_below_bound)


def bits_of(p: Tensor, p_min: float, grad_below_bound: bool) -> Tensor:
    """-log2 of probabilities, bounded below by p_min as `lower_bound` does it."""
    return -torch.log2(lower_bound(p, p_min, grad_below_bound=grad_below_bound))


def gaussian_mass(x: Tensor, mu: Tensor | float, sigma: Tensor | float, step: Tensor | float = 1.0) -> Tensor:
    """Probability of the bin [x - step/2, x + step/2] under N(mu, sigma).

    Stable at any distance: |x - mu| is used, so no two numbers near 1 are subtracted.
    """
    away = (x - mu).abs()
    scale = 1 / (torch.as_tensor(sigma, dtype=x.dtype, device=x.device) * math.sqrt(2))
    return 0.5 * (torch.erfc((away - step / 2) * scale) - torch.erfc((away + step / 2) * scale))


def gaussian_bits(
    x: Tensor,
    mu: Tensor | float,
    sigma: Tensor | float,
    step: Tensor | float = 1.0,
    *,
    p_min: float = CODER_FLOOR,
    grad_below_bound: bool = True,
) -> Tensor:
    """Bits of the bin [x - step/2, x + step/2] under N(mu, sigma); shape of x.

    p_min   HAC: 1e-6; 2^-24 compares with the coder
    """
    if fast_bits.fits(x, mu, sigma, step):
        return fast_bits.gaussian_bits(x, mu, sigma, step, p_min=p_min, grad_below_bound=grad_below_bound)
    return bits_of(gaussian_mass(x, mu, sigma, step), p_min, grad_below_bound)


def mask_bits(mask: Tensor) -> Tensor:
    """Total bits of a mask of 0 and 1 with its own share of ones, plus 32 for that share; a scalar.

    Differentiable through the number of ones when the mask comes out of a straight-through estimator.
    """
    n, ones = mask.numel(), mask.sum()
    p = (ones / max(n, 1)).clamp(1e-6, 1 - 1e-6)
    return -ones * torch.log2(p) - (n - ones) * torch.log2(1 - p) + 32
