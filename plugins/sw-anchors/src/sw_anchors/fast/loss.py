"""Loss terms as single autograd nodes, since launching operators dominates the cost of a step."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def mean_product(scales: Tensor, count: int | Tensor) -> Tensor:
    """Fast version of `stage.mean_product`, whose backward tests for zeros and so waits for a GPU."""
    found: Tensor = _MeanProduct.apply(scales, count)  # type: ignore[no-untyped-call]
    return found


class _MeanProduct(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, count: int | Tensor) -> Tensor:
        found, others = product_and_slopes(scales, count)
        ctx.save_for_backward(others)
        ctx.count = count
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        (others,) = ctx.saved_tensors
        return others * (grad / ctx.count), None


def product_and_slopes(scales: Tensor, count: int | Tensor) -> tuple[Tensor, Tensor]:
    """Return `mean_product` without gradient, and count times its gradient, the products of the two other scales."""
    others = scales.roll(1, 1) * scales.roll(-1, 1)
    return (others.select(1, 0) * scales.select(1, 0)).sum() / count, others


def weighted_sum(start: Tensor, *terms: tuple[float, Tensor]) -> tuple[Tensor, ...]:
    """Fast version of `stage.weighted_sum`, which launches four kernels per scalar term."""
    found: tuple[Tensor, ...] = _WeightedSum.apply([weight for weight, _ in terms], start, *(t for _, t in terms))  # type: ignore[no-untyped-call]
    return found


class _WeightedSum(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: list[float], start: Tensor, *terms: Tensor) -> tuple[Tensor, ...]:
        ctx.weights = weights
        weighted = torch._foreach_mul(terms, weights) if terms else []
        ctx.mark_non_differentiable(*weighted)
        return torch.stack([start, *weighted]).sum(), *weighted

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor, *_: Tensor) -> tuple[Tensor | None, ...]:
        slopes = torch._foreach_mul([slope] * len(ctx.weights), ctx.weights) if ctx.weights else []
        return None, slope, *slopes
