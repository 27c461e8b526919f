"""One Adam step: a compiled kernel on the CPU, one launch for all tensors on CUDA, torch's own everywhere else."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.optim.adam import adam

from splatwizard_core.errors import ShapeError
from splatwizard_core.training.native import TRAINING


@dataclass(slots=True)
class AdamUpdate:
    """The arguments of one `adam_step`."""

    param: Tensor
    grad: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor
    lr: float
    beta1: float
    beta2: float
    eps: float
    step: int


@torch.no_grad()
def adam_steps(updates: Sequence[AdamUpdate]) -> None:
    """`adam_step` for each of them: the same numbers, on CUDA in one launch."""
    together = [u for u in updates if u.param.is_cuda]
    if together and TRAINING.has_cuda():
        left = torch.ops.splatwizard_training.adam_many(
            [u.param for u in together], [u.grad for u in together],
            [u.exp_avg for u in together], [u.exp_avg_sq for u in together],
            [u.lr for u in together], [u.beta1 for u in together], [u.beta2 for u in together],
            [u.eps for u in together], [u.step for u in together],
        )  # fmt: skip
        _mark_written(*(u.param for u in together))
        if not left and len(together) == len(updates):
            return
        updates = [u for u in updates if not u.param.is_cuda] + [together[i] for i in left]
    for u in updates:
        adam_step(
            u.param, u.grad, u.exp_avg, u.exp_avg_sq,
            lr=u.lr, beta1=u.beta1, beta2=u.beta2, eps=u.eps, step=u.step,
        )  # fmt: skip


def _mark_written(*tensors: Tensor) -> None:
    """The kernels write behind autograd's back."""
    for tensor in tensors:
        torch.autograd.graph.increment_version(tensor)


@torch.no_grad()
def adam_step(
    param: Tensor,
    grad: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    *,
    lr: float,
    beta1: float,
    beta2: float,
    eps: float,
    step: int,
) -> None:
    """Update `param`, `exp_avg` and `exp_avg_sq` in place, densely; the same numbers as torch.optim.Adam to 1e-6.

    param, grad, exp_avg, exp_avg_sq    any shape, alike
    step                                of this update, from 1

    Raises ShapeError if the shapes differ.
    Source: Kingma & Ba (arXiv 1412.6980), bias correction as torch applies it.
    """
    for name, tensor in (("grad", grad), ("exp_avg", exp_avg), ("exp_avg_sq", exp_avg_sq)):
        if tensor.shape != param.shape:
            raise ShapeError(
                f"{name} is {list(tensor.shape)}, the parameter {list(param.shape)}",
                actual=tensor.shape,
                expected=tuple(param.shape),
            )
    if step < 1:
        raise ValueError(f"Adam's step counts from 1, got {step}")
    grad = grad.contiguous()
    tensors = (param, grad, exp_avg, exp_avg_sq)
    if not all(t.is_contiguous() for t in tensors):
        exp_avg.lerp_(grad, 1.0 - beta1)
        exp_avg_sq.mul_(beta2).addcmul_(grad, grad, value=1.0 - beta2)
        denominator = exp_avg_sq.sqrt().div_(math.sqrt(1.0 - beta2**step)).add_(eps)
        param.addcdiv_(exp_avg, denominator, value=-lr / (1.0 - beta1**step))
        return
    if all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors) and TRAINING.try_load():
        torch.ops.splatwizard_training.adam(*tensors, lr, beta1, beta2, eps, step)
    else:
        count = torch.tensor(float(step - 1), device=param.device)  # steps done; torch counts this one itself
        adam(
            [param], [grad], [exp_avg], [exp_avg_sq], [], [count], fused=True, amsgrad=False, maximize=False,
            weight_decay=0.0, lr=lr, beta1=beta1, beta2=beta2, eps=eps,
        )  # fmt: skip
    _mark_written(param)
