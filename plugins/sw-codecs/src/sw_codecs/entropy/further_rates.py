"""Rate estimates for training: bits per element under Laplace, mixture, Bernoulli and categorical models.

All are differentiable in every float argument, on any device. Source: specification of the codec library, entropy
models (rate estimators).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sw_codecs.entropy.rates import CODER_FLOOR, bits_of, gaussian_mass


def laplace_mass(x: Tensor, mu: Tensor | float, b: Tensor | float, step: Tensor | float = 1.0) -> Tensor:
    """Probability of the bin [x - step/2, x + step/2] under the density exp(-|x - mu| / b) / 2b; stable likewise."""
    away = (x - mu).abs()
    near, far = (away - step / 2) / b, (away + step / 2) / b
    # Mirrored to the right of the mean: P = S(near) - S(far), S(t) = 1/2 exp(-t) for t >= 0, else 1 - 1/2 exp(t).
    upper = torch.where(near >= 0, 0.5 * torch.exp(-near.clamp_min(0)), 1 - 0.5 * torch.exp(near.clamp_max(0)))
    return upper - 0.5 * torch.exp(-far)


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


def categorical_bits(symbols: Tensor, logits: Tensor) -> Tensor:
    """Bits of symbols [...] int64 under softmax(logits [..., K])."""
    return -torch.log_softmax(logits, -1).gather(-1, symbols[..., None]).squeeze(-1) / math.log(2)
