"""Adam of the rows that a view shows: compiled kernels on the CPU and on CUDA, torch operations everywhere else."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from splatwizard_core.api import ShapeError, SplatOptimizer
from splatwizard_native import AdamUpdate
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

    Not the trajectory of Adam: a row that is not seen has no momentum. Where every row is marked each time, "per_row"
    is Adam, to rounding. On CUDA hidden rows are not read, and nothing waits.
    Raises ShapeError if shapes differ, ValueError if `row_steps` and `bias_correction` do not go together.
    Source: Taming 3DGS (arXiv 2406.15643).
    """
    if (bias_correction == "per_row") != (row_steps is not None):
        raise ValueError('row_steps goes with bias_correction="per_row", and only with that')
    sparse_adam_steps(
        [AdamUpdate(param, grad, exp_avg, exp_avg_sq, lr=lr, beta1=beta1, beta2=beta2, eps=eps, step=0)],
        rows,
        [row_steps],
    )


@torch.no_grad()
def sparse_adam_steps(updates: Sequence[AdamUpdate], rows: Tensor, row_steps: Sequence[Tensor | None]) -> None:
    """Update the marked rows of many parameters [N, ...] as `sparse_adam` does; on CUDA in one launch.

    updates     `step` of each is not looked at
    rows        [N] bool
    row_steps   of each update: [N] int32, for the bias correction of its rows; None: it has none
    """
    for u, steps in zip(updates, row_steps, strict=True):
        _check(u, rows, steps)
    left = range(len(updates))
    if updates and rows.is_cuda and GAUSSIANS.has_cuda():
        nothing = rows.new_empty(0, dtype=torch.int32)
        left = torch.ops.splatwizard_gaussians.sparse_adam_many(
            [u.param for u in updates], [u.grad.contiguous() for u in updates],
            [u.exp_avg for u in updates], [u.exp_avg_sq for u in updates],
            [nothing if steps is None else steps for steps in row_steps], rows.contiguous(),
            [u.lr for u in updates], [u.beta1 for u in updates], [u.beta2 for u in updates], [u.eps for u in updates],
        )  # fmt: skip
        for u in updates:
            _written(u)
    for i in left:
        _one(updates[i], rows, row_steps[i])


def _check(u: AdamUpdate, rows: Tensor, row_steps: Tensor | None) -> None:
    param, n = u.param, u.param.shape[:1]
    expected = [("grad", u.grad, param.shape), ("exp_avg", u.exp_avg, param.shape)]
    expected += [("exp_avg_sq", u.exp_avg_sq, param.shape), ("rows", rows, n)]
    expected += [] if row_steps is None else [("row_steps", row_steps, n)]
    for name, tensor, shape in expected:
        if tensor.shape != shape or param.dim() == 0:
            raise ShapeError(
                f"{name} is {list(tensor.shape)}, the parameter {list(param.shape)}: it must be {list(shape)}",
                actual=tensor.shape,
                expected=tuple(shape),
            )


def _written(u: AdamUpdate) -> None:
    """Tell autograd of what a kernel has written behind its back."""
    for tensor in (u.param, u.exp_avg, u.exp_avg_sq):
        torch.autograd.graph.increment_version(tensor)


def _one(u: AdamUpdate, rows: Tensor, row_steps: Tensor | None) -> None:
    """Update one parameter by the kernel of the CPU, or by torch operations."""
    param, grad, exp_avg, exp_avg_sq = u.param, u.grad.contiguous(), u.exp_avg, u.exp_avg_sq
    floats = (param, grad, exp_avg, exp_avg_sq)
    compiled = all(t.device.type == "cpu" and t.dtype == torch.float32 and t.is_contiguous() for t in floats)
    if compiled and GAUSSIANS.try_load():
        torch.ops.splatwizard_gaussians.sparse_adam(
            *floats, rows.contiguous(), row_steps, u.lr, u.beta1, u.beta2, u.eps
        )
        _written(u)
        return
    seen = rows.view(-1, *[1] * (param.dim() - 1))
    average = torch.lerp(exp_avg, grad, 1.0 - u.beta1)
    square = (u.beta2 * exp_avg_sq).addcmul_(grad, grad, value=1.0 - u.beta2)
    if row_steps is None:
        update = average / (square.sqrt() + u.eps)
    else:
        row_steps.add_(rows)
        t = row_steps.clamp(min=1).double().view(seen.shape)
        first = -torch.expm1(t * math.log(u.beta1)).to(param)
        second = torch.sqrt(-torch.expm1(t * math.log(u.beta2))).to(param)
        update = average / first / ((square.sqrt() / second).add_(u.eps))
    # Chosen, not multiplied by the mask: what is not looked at may be anything, NaN too.
    param.copy_(torch.where(seen, param - u.lr * update, param))
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
        dense, sparse, steps = [], [], []
        for name, update in self.due():
            if name not in self.model.ROWS:
                dense.append(update)
                continue
            state = self.states[name].tensors
            if self.bias_correction == "per_row" and "row_steps" not in state:
                state["row_steps"] = torch.zeros(len(update.param), dtype=torch.int32, device=update.param.device)
            sparse.append(update)
            steps.append(state.get("row_steps"))
        if sparse:
            param = sparse[0].param
            if rows is None:
                rows = torch.ones(len(param), dtype=torch.bool, device=param.device)
            sparse_adam_steps(sparse, rows, steps)
        self.update(dense)
