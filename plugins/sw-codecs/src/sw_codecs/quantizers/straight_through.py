"""One autograd node for every quantizer: forward is the lattice value to the bit, backward goes to the input."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _StraightThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, values: Tensor, inside: Tensor | None) -> Tensor:
        ctx.inside = inside
        return values.to(x.dtype).view_as(x)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:  # type: ignore[override]
        return (grad if ctx.inside is None else grad * ctx.inside), None, None


def straight_through(x: Tensor, values: Tensor, inside: Tensor | None = None) -> Tensor:
    """`values`, of the shape of x, with gradient 1 to x, or 0 where `inside` (bool) says no.

    x + (values - x).detach() would be the same but for the last bit, and the last bit decides what a renderer shows.
    """
    return _StraightThrough.apply(x, values.detach(), inside)


def signs(x: Tensor) -> Tensor:
    """Return +1 where x >= 0, else -1; gradient 1 for |x| <= 1, else 0."""
    return straight_through(x, torch.where(x >= 0, 1.0, -1.0), x.detach().abs() <= 1)


def hard_mask(x: Tensor, threshold: float, weight: float | Tensor = 1.0) -> Tensor:
    """Return 1 where sigmoid(x) * weight > threshold, else 0; the gradient is that of sigmoid(x) * weight."""
    soft = torch.sigmoid(x) * weight
    return straight_through(soft, soft > threshold)
