"""Rate estimates for training: bits per element under Gaussian, Laplace, mixture, Bernoulli and categorical models.

All are differentiable in every float argument, on any device. Source: specification of the codec library, entropy
models (rate estimators).
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

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
    if isinstance(mu, Tensor) and isinstance(sigma, Tensor) and isinstance(step, Tensor) and mu.dtype == x.dtype:
        found: Tensor = _GaussianBits.apply(x, mu, sigma, step, p_min, grad_below_bound)  # type: ignore[no-untyped-call]
        return found
    return bits_of(gaussian_mass(x, mu, sigma, step), p_min, grad_below_bound)


class _GaussianBits(torch.autograd.Function):
    """`bits_of(gaussian_mass(...))` with its gradient written down: a third of the operators."""

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
