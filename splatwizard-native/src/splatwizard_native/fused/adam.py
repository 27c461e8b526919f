"""One Adam step: a compiled kernel on the CPU, one launch for all tensors on CUDA, torch's own everywhere else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.optim.adam import adam

from splatwizard_native.fused.native import TRAINING


@dataclass(slots=True)
class AdamUpdate:
    """One Adam update of a tensor.

    param, grad, exp_avg, exp_avg_sq    any shape, alike
    step                                of this update, from 1
    """

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
    """Update `param`, `exp_avg` and `exp_avg_sq` of each in place, densely; as torch.optim.Adam, to 1e-6.

    On CUDA in one launch. Raises ValueError if shapes differ.
    Source: Kingma & Ba (arXiv 1412.6980), bias correction as torch applies it.
    """
    together = [u for u in updates if u.param.is_cuda]
    if together and TRAINING.has_cuda():
        left = torch.ops.splatwizard_training.adam_many(
            [u.param for u in together], [u.grad for u in together],
            [u.exp_avg for u in together], [u.exp_avg_sq for u in together],
            [u.lr for u in together], [u.beta1 for u in together], [u.beta2 for u in together],
            [u.eps for u in together], [u.step for u in together],
        )  # fmt: skip
        for u in together:
            torch.autograd.graph.increment_version(u.param)  # the kernels write behind autograd's back
        updates = [u for u in updates if not u.param.is_cuda] + [together[i] for i in left]
    for u in updates:
        _step(u)


def _step(u: AdamUpdate) -> None:
    param, exp_avg, exp_avg_sq = u.param, u.exp_avg, u.exp_avg_sq
    for name in ("grad", "exp_avg", "exp_avg_sq"):
        shape = getattr(u, name).shape
        if shape != param.shape:
            raise ValueError(f"{name} is {list(shape)}, the parameter {list(param.shape)}")
    if u.step < 1:
        raise ValueError(f"Adam's step counts from 1, got {u.step}")
    grad = u.grad.contiguous()
    tensors = (param, grad, exp_avg, exp_avg_sq)
    whole = all(t.is_contiguous() for t in tensors)
    if whole and all(t.device.type == "cpu" and t.dtype == torch.float32 for t in tensors) and TRAINING.try_load():
        torch.ops.splatwizard_training.adam(*tensors, u.lr, u.beta1, u.beta2, u.eps, u.step)
    else:
        count = torch.tensor(float(u.step - 1), device=param.device)  # steps done; torch counts this one itself
        adam(
            [param], [grad], [exp_avg], [exp_avg_sq], [], [count], fused=whole, foreach=False, amsgrad=False,
            maximize=False, weight_decay=0.0, lr=u.lr, beta1=u.beta1, beta2=u.beta2, eps=u.eps,
        )  # fmt: skip
    torch.autograd.graph.increment_version(param)
