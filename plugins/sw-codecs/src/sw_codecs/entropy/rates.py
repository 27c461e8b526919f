"""Rate estimates for training: bits per element under Gaussian, Laplace, mixture, Bernoulli and categorical models.

All are differentiable in every float argument, on any device. Source: specification of the codec library, entropy
models (rate estimators).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from sw_codecs.entropy.fast import gaussian_bits as fast_bits

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


def laplace_mass(x: Tensor, mu: Tensor | float, b: Tensor | float, step: Tensor | float = 1.0) -> Tensor:
    """Probability of the bin [x - step/2, x + step/2] under the density exp(-|x - mu| / b) / 2b; stable likewise."""
    away = (x - mu).abs()
    near, far = (away - step / 2) / b, (away + step / 2) / b
    # Mirrored to the right of the mean: P = S(near) - S(far), S(t) = 1/2 exp(-t) for t >= 0, else 1 - 1/2 exp(t).
    upper = torch.where(near >= 0, 0.5 * torch.exp(-near.clamp_min(0)), 1 - 0.5 * torch.exp(near.clamp_max(0)))
    return upper - 0.5 * torch.exp(-far)


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


def laplace_bits(
    x: Tensor,
    mu: Tensor | float,
    b: Tensor | float,
    step: Tensor | float = 1.0,
    *,
    p_min: float = CODER_FLOOR,
    grad_below_bound: bool = True,
) -> Tensor:
    """Bits of the bin [x - step/2, x + step/2] under the density exp(-|x - mu| / b) / 2b; shape of x."""
    return bits_of(laplace_mass(x, mu, b, step), p_min, grad_below_bound)


def mixture_bits(
    x: Tensor,
    logits: Tensor,
    mu: Tensor,
    scale: Tensor,
    step: Tensor | float = 1.0,
    *,
    p_min: float = CODER_FLOOR,
    grad_below_bound: bool = True,
) -> Tensor:
    """Bits of the bin [x - step/2, x + step/2] under sum_i softmax(logits)_i N(mu_i, scale_i); shape of x.

    logits, mu, scale   [..., K], the leading axes broadcast with x; K components
    step                a number, or broadcasts with x
    """
    width = step[..., None] if isinstance(step, Tensor) and step.ndim else step
    mass = gaussian_mass(x[..., None], mu, scale, width)
    return bits_of((torch.softmax(logits, -1) * mass).sum(-1), p_min, grad_below_bound)


def bernoulli_bits(symbols: Tensor, p: Tensor | float) -> Tensor:
    """Bits of symbols in {0, 1} (or relaxed in between) with P(1) = p, clamped to 1e-6 from 0 and 1."""
    dtype = torch.promote_types(symbols.dtype, torch.get_default_dtype())
    p = torch.as_tensor(p, dtype=dtype, device=symbols.device).clamp(1e-6, 1 - 1e-6)
    return -symbols * torch.log2(p) - (1 - symbols) * torch.log2(1 - p)


def mask_bits(mask: Tensor) -> Tensor:
    """Total bits of a mask of 0 and 1 with its own share of ones, plus 32 for that share; a scalar.

    Differentiable through the number of ones when the mask comes out of a straight-through estimator.
    """
    n, ones = mask.numel(), mask.sum()
    p = (ones / max(n, 1)).clamp(1e-6, 1 - 1e-6)
    return -ones * torch.log2(p) - (n - ones) * torch.log2(1 - p) + 32


def categorical_bits(symbols: Tensor, logits: Tensor) -> Tensor:
    """Bits of symbols [...] int64 under softmax(logits [..., K])."""
    return -torch.log_softmax(logits, -1).gather(-1, symbols[..., None]).squeeze(-1) / math.log(2)
