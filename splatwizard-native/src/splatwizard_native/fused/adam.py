"""One Adam step: a compiled kernel on the CPU, one launch for all tensors on CUDA, torch's own everywhere else."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.optim.adam import adam

from splatwizard_native.fused import cuda_face, face
from splatwizard_native.fused.native import TRAINING

UPDATE = "4Pq4dq"  # of `struct`, for `adam_update` of kernels/face.h


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


def adam_steps(updates: Sequence[AdamUpdate]) -> None:
    """Update `param`, `exp_avg` and `exp_avg_sq` of each in place, densely; as torch.optim.Adam, to 1e-6.

    All in one call of the kernels, on CUDA in one launch. Raises ValueError before any is done if shapes differ.
    Source: Kingma & Ba (arXiv 1412.6980), bias correction as torch applies it.
    """
    by_device: dict[torch.device, list[AdamUpdate]] = {}
    for u in updates:
        _check(u)
        by_device.setdefault(u.param.device, []).append(u)
    for device, together in by_device.items():
        if (device.type == "cuda" and TRAINING.has_cuda()) or (device.type == "cpu" and TRAINING.try_load()):
            together = _fused(together, device)
        for u in together:
            _by_torch(u)


def _fused(updates: Sequence[AdamUpdate], device: torch.device) -> list[AdamUpdate]:
    """Do these updates, of tensors on a device with kernels, in one call; return those that they do not take."""
    operations: Any = cuda_face if device.type == "cuda" else face
    alignment, more = (16, {"device": device.index}) if device.type == "cuda" else (1, {})
    index, numbers, held, left = -1 if device.index is None else device.index, list[float](), [], []
    for u in updates:
        p, g, m, v = tensors = u.param, u.grad.contiguous(), u.exp_avg, u.exp_avg_sq
        at = p.data_ptr(), g.data_ptr(), m.data_ptr(), v.data_ptr()
        whole = p.is_contiguous() and m.is_contiguous() and v.is_contiguous()
        here = p.get_device() == g.get_device() == m.get_device() == v.get_device() == index
        aligned = (at[0] | at[1] | at[2] | at[3]) % alignment == 0
        if whole and here and aligned and p.dtype is g.dtype is m.dtype is v.dtype is torch.float32:
            held.append(tensors)  # alive until the call
            numbers += (*at, p.numel(), u.lr, u.beta1, u.beta2, u.eps, u.step)
        else:
            left.append(u)
    rows = bytearray(struct.pack("@" + UPDATE * len(held), *numbers))  # structs made one by one took ten times as long
    operations.adam(updates=(operations.adam_update * len(held)).from_buffer(rows), count=len(held), **more)
    torch.autograd.graph.increment_version([tensors[0] for tensors in held])
    return left


def _check(u: AdamUpdate) -> None:
    shape = u.param.shape
    if u.grad.shape != shape or u.exp_avg.shape != shape or u.exp_avg_sq.shape != shape:
        name = next(name for name in ("grad", "exp_avg", "exp_avg_sq") if getattr(u, name).shape != shape)
        raise ValueError(f"{name} is {list(getattr(u, name).shape)}, the parameter {list(shape)}")
    if u.step < 1:
        raise ValueError(f"Adam's step counts from 1, got {u.step}")


@torch.no_grad()
def _by_torch(u: AdamUpdate) -> None:
    whole = all(t.is_contiguous() for t in (u.param, u.exp_avg, u.exp_avg_sq))
    count = torch.tensor(float(u.step - 1), device=u.param.device)  # steps done; torch counts this one itself
    adam(
        [u.param], [u.grad.contiguous()], [u.exp_avg], [u.exp_avg_sq], [], [count], fused=whole, foreach=False,
        amsgrad=False, maximize=False, weight_decay=0.0, lr=u.lr, beta1=u.beta1, beta2=u.beta2, eps=u.eps,
    )  # fmt: skip
    torch.autograd.graph.increment_version(u.param)
