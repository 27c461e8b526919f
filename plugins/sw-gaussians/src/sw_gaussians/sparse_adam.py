"""Sparse Adam: updates only the rows (Gaussians) visible in the current view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.api import ShapeError, SplatOptimizer
from splatwizard_native import AdamUpdate
from sw_gaussians.fast import sparse_adam as fast

if TYPE_CHECKING:
    from splatwizard_core.api import RenderResult


@torch.no_grad()
def sparse_adam(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    rows: Tensor,
    *,
    lr: float,
    beta1: float,
    beta2: float,
    eps: float,
) -> None:
    """Update the marked rows of `param`, `exp_avg` and `exp_avg_sq` in place; the others keep every bit.

    param, grad, exp_avg, exp_avg_sq    [N, ...], alike; gradient rows that are not marked are not looked at
    rows                [N] bool, which are updated: what a view shows, or any other choice

    No bias correction, as published: the first step of a row is (1 - beta1) / sqrt(1 - beta2) = 3.16 times `lr`. Not
    the trajectory of Adam: a row that is not seen has no momentum. Raises ShapeError if shapes differ.
    Source: Taming 3DGS (arXiv 2406.15643).
    """
    update = AdamUpdate(param, grad, exp_avg, exp_avg_sq, lr=lr, beta1=beta1, beta2=beta2, eps=eps, step=0)
    sparse_adam_steps([update], rows)


@torch.no_grad()
def sparse_adam_steps(updates: Sequence[AdamUpdate], rows: Tensor) -> None:
    """Update the marked rows [N] bool of many parameters [N, ...] as `sparse_adam` does; ignores `step`."""
    for update in updates:
        _check(update, rows)
    for update in fast.left_of(updates, rows):
        update_rows(update, rows)


def update_rows(u: AdamUpdate, rows: Tensor) -> None:
    """Update the marked rows of one parameter."""
    param, grad, exp_avg, exp_avg_sq = u.param, u.grad, u.exp_avg, u.exp_avg_sq
    seen = rows.view(-1, *[1] * (param.dim() - 1))
    average = torch.lerp(exp_avg, grad, 1.0 - u.beta1)
    square = (u.beta2 * exp_avg_sq).addcmul_(grad, grad, value=1.0 - u.beta2)
    update = average / (square.sqrt() + u.eps)
    # Chosen, not multiplied by the mask: what is not looked at may be anything, NaN too.
    param.copy_(torch.where(seen, param - u.lr * update, param))
    exp_avg.copy_(torch.where(seen, average, exp_avg))
    exp_avg_sq.copy_(torch.where(seen, square, exp_avg_sq))


def _check(u: AdamUpdate, rows: Tensor) -> None:
    param, n = u.param, u.param.shape[:1]
    expected = [("grad", u.grad, param.shape), ("exp_avg", u.exp_avg, param.shape)]
    expected += [("exp_avg_sq", u.exp_avg_sq, param.shape), ("rows", rows, n)]
    for name, tensor, shape in expected:
        if tensor.shape != shape or param.dim() == 0:
            raise ShapeError(
                f"{name} is {list(tensor.shape)}, the parameter {list(param.shape)}: it must be {list(shape)}"
            )


class SparseSplatOptimizer(SplatOptimizer):
    """Adam that updates only the Gaussians visible in the view; parameters without rows (networks) densely."""

    def step(self, result: RenderResult | None = None) -> None:
        self.step_rows(None if result is None else result.visible)

    @torch.no_grad()
    def step_rows(self, rows: Tensor | None) -> None:
        """Update the marked rows [N] bool; None: all of them. Raises ShapeError if the mask does not fit."""
        dense: list[AdamUpdate] = []
        sparse: list[AdamUpdate] = []
        for name, update in self.due():
            (sparse if name in self.model.ROWS else dense).append(update)
        if sparse:
            param = sparse[0].param
            if rows is None:
                rows = torch.ones(len(param), dtype=torch.bool, device=param.device)
            sparse_adam_steps(sparse, rows)
        self.update(dense)
