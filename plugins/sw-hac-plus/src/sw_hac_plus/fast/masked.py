"""Values times masks that are 1: the same values, with a gradient for the masks."""

from __future__ import annotations

from typing import Any

import torch
from sw_anchors.fast.rows import AlikeRows, Way
from torch import Tensor
from torch.autograd.function import once_differentiable


def masked(values: Tensor, factors: Tensor, rows: Tensor) -> Tensor:
    """As `masked` of sw_hac_plus.model: factors at `rows` are 1, so it is the same values with another gradient."""
    found: Tensor = _Masked.apply(values, factors, rows)  # type: ignore[no-untyped-call]
    return found


class _Masked(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, factors: Tensor, rows: Tensor) -> Tensor:
        ctx.save_for_backward(values, rows)
        ctx.shape = factors.shape
        return values.view_as(values)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        values, rows = ctx.saved_tensors
        (to_factors,) = _PUT.put(rows, [(grad * values).sum(dim=1)], [torch.Size([ctx.shape.numel()])])
        assert to_factors is not None
        return grad, to_factors.view(ctx.shape), None


_PUT = AlikeRows(Way.SCATTER)
