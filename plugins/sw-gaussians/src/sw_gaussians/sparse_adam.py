"""Adam of the rows that a view shows: a compiled kernel on the CPU, torch operations everywhere else."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from splatwizard_core.api import ShapeError, SplatOptimizer
from sw_gaussians.native import GAUSSIANS

if TYPE_CHECKING:
    from splatwizard_core.api import ParamGroup, RenderResult, SplatModel

BiasCorrection = Literal["none", "per_row"]


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
    bias_correction: BiasCorrection = "none",
    row_steps: Tensor | None = None,
) -> None:
    """Update the marked rows of `param`, `exp_avg` and `exp_avg_sq` in place; the others keep every bit.

    param, grad, exp_avg, exp_avg_sq    [N, ...], alike; gradient rows that are not marked are not looked at
    rows                [N] bool, which are updated: what a view shows, or any other choice
    bias_correction     "none" as published, so that a first step is (1 - beta1) / sqrt(1 - beta2) = 3.16 times `lr`;
                        "per_row": by the number of updates that a row has had, so that a first step is `lr`
    row_steps           [N] int32, that number, counted up here; "per_row" needs it

    Not the trajectory of Adam: a row that is not seen has no momentum. On CUDA all rows are passed over, with no wait.
    Raises ShapeError if shapes differ, ValueError if `row_steps` and `bias_correction` do not go together.
    Source: Taming 3DGS (arXiv 2406.15643).
    """
    if (bias_correction == "per_row") != (row_steps is not None):
        raise ValueError('row_steps goes with bias_correction="per_row", and only with that')
    n = param.shape[:1]
    expected = [("grad", grad, param.shape), ("exp_avg", exp_avg, param.shape), ("exp_avg_sq", exp_avg_sq, param.shape)]
    expected += [("rows", rows, n)] + ([] if row_steps is None else [("row_steps", row_steps, n)])
    for name, tensor, shape in expected:
        if tensor.shape != shape or param.dim() == 0:
            raise ShapeError(
                f"{name} is {list(tensor.shape)}, the parameter {list(param.shape)}: it must be {list(shape)}",
                actual=tensor.shape,
                expected=tuple(shape),
            )
    grad = grad.contiguous()
    floats = (param, grad, exp_avg, exp_avg_sq)
    compiled = all(t.device.type == "cpu" and t.dtype == torch.float32 and t.is_contiguous() for t in floats)
    if compiled and GAUSSIANS.try_load():
        torch.ops.splatwizard_gaussians.sparse_adam(*floats, rows.contiguous(), row_steps, lr, beta1, beta2, eps)
        for tensor in (param, exp_avg, exp_avg_sq):  # the kernel writes behind autograd's back
            torch.autograd.graph.increment_version(tensor)
        return
    seen = rows.view(-1, *[1] * (param.dim() - 1))
    average = torch.lerp(exp_avg, grad, 1.0 - beta1)
    square = (beta2 * exp_avg_sq).addcmul_(grad, grad, value=1.0 - beta2)
    if row_steps is None:
        update = average / (square.sqrt() + eps)
    else:
        row_steps.add_(rows)
        t = row_steps.clamp(min=1).double().view(seen.shape)
        first = -torch.expm1(t * math.log(beta1)).to(param)
        second = torch.sqrt(-torch.expm1(t * math.log(beta2))).to(param)
        update = average / first / ((square.sqrt() / second).add_(eps))
    # Chosen, not multiplied by the mask: what is not looked at may be anything, NaN too.
    param.copy_(torch.where(seen, param - lr * update, param))
    exp_avg.copy_(torch.where(seen, average, exp_avg))
    exp_avg_sq.copy_(torch.where(seen, square, exp_avg_sq))


class SparseSplatOptimizer(SplatOptimizer):
    """Adam that updates only the Gaussians that the view shows; parameters without rows (networks) as always.

    bias_correction     as in `sparse_adam`; with "per_row" a state holds "row_steps" [N] int32, the updates of each row
    """

    def __init__(
        self, model: SplatModel, groups: Iterable[ParamGroup], *, bias_correction: BiasCorrection = "none"
    ) -> None:
        super().__init__(model, groups)
        self.bias_correction: BiasCorrection = bias_correction

    def step(self, result: RenderResult | None = None) -> None:
        self.step_rows(None if result is None else result.visible)

    @torch.no_grad()
    def step_rows(self, rows: Tensor | None) -> None:
        """Update the marked rows [N] bool; None: all of them. Raises ShapeError if the mask does not fit."""
        dense = []
        for name, update in self.due():
            if name not in self.model.ROWS:
                dense.append(update)
                continue
            state = self.states[name].tensors
            if rows is None:
                rows = torch.ones(len(update.param), dtype=torch.bool, device=update.param.device)
            if self.bias_correction == "per_row" and "row_steps" not in state:
                state["row_steps"] = torch.zeros(len(update.param), dtype=torch.int32, device=update.param.device)
            sparse_adam(
                update.param, update.grad, update.exp_avg, update.exp_avg_sq, rows,
                lr=update.lr, beta1=update.beta1, beta2=update.beta2, eps=update.eps,
                bias_correction=self.bias_correction, row_steps=state.get("row_steps"),
            )  # fmt: skip
        self.update(dense)
