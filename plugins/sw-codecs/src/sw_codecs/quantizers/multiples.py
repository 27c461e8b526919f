"""Rounding to multiples of a step, half to even (torch.round), and the noise that stands in for it in training.

Noise and rounding never mix: training renders and rates the noisy value, everything else the rounded one.
"""

from __future__ import annotations

import torch
from torch import Tensor

INDEX_CLAMP = 15_000
"""Largest distance of an index from that of the mean: ranges of indices then fit int16. Source: HAC (2403.14530)."""
INDEX_LIMIT = 1 << 30


def nearest_index(x: Tensor, step: Tensor, mean: Tensor) -> Tensor:
    """Return round(x / step), at most INDEX_CLAMP from round(mean / step); of the shape and type of x, no gradient.

    step    > 0, broadcasts with x
    mean    scalar: that of the whole tensor, where x is a part of it
    """
    step = step.detach().to(x)
    centre = torch.round(mean.detach().to(x) / step)
    return torch.clamp(torch.round(x.detach() / step), centre - INDEX_CLAMP, centre + INDEX_CLAMP)


def symbols_of(x: Tensor, step: Tensor, mean: Tensor) -> Tensor:
    """Return `nearest_index` as int64, for a file. Raises ValueError if something is not finite or beyond 2^30."""
    if not bool((step > 0).all() and torch.isfinite(step).all()):
        raise ValueError("a quantizer step must be positive and finite")
    if not bool(torch.isfinite(x).all()):
        raise ValueError("values to quantize must be finite")
    return checked(nearest_index(x, step, mean))


def checked(index: Tensor) -> Tensor:
    """Return indices as int64. Raises ValueError for one beyond 2^30."""
    if index.numel() and not float(index.abs().max()) < INDEX_LIMIT:
        raise ValueError("a quantizer index is beyond 2^30: the step is too small")
    return index.to(torch.int64)


def add_noise(x: Tensor, step: Tensor, uniform: Tensor) -> Tensor:
    """x + step * (u - 1/2), as one operator: rounding to multiples of `step` as it is seen in training; differentiable.

    uniform     draws u ~ U(0,1) of the shape of x; they are overwritten
    """
    return torch.addcmul(x, uniform.sub_(0.5), step)
