"""Compiled sparse Adam: one call for all parameters, on CUDA one launch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from splatwizard_native import AdamUpdate
from sw_gaussians import face
from sw_gaussians.native import GAUSSIANS


def left_of(updates: Sequence[AdamUpdate], rows: Tensor) -> list[AdamUpdate]:
    """Run the updates that a kernel supports, for the marked rows [N] bool; return the others."""
    if not updates:
        return []
    if rows.is_cuda and GAUSSIANS.has_cuda():
        return _on_cuda(updates, rows)
    return _on_cpu(updates, rows) if rows.is_cpu and GAUSSIANS.try_load() else list(updates)


def _on_cuda(updates: Sequence[AdamUpdate], rows: Tensor) -> list[AdamUpdate]:
    """Do these updates, for rows on CUDA; return those that the kernel does not take."""
    nothing = rows.new_empty(0, dtype=torch.int32)
    undone = torch.ops.splatwizard_gaussians.sparse_adam_many(
        [u.param for u in updates], [u.grad.contiguous() for u in updates],
        [u.exp_avg for u in updates], [u.exp_avg_sq for u in updates],
        [nothing for _ in updates], rows.contiguous(),
        [u.lr for u in updates], [u.beta1 for u in updates], [u.beta2 for u in updates], [u.eps for u in updates],
    )  # fmt: skip
    _written(updates)
    return [updates[i] for i in undone]


def _on_cpu(updates: Sequence[AdamUpdate], rows: Tensor) -> list[AdamUpdate]:
    """Do these updates, for rows on the CPU; return those that the kernel does not take."""
    listed, held, done, left = [], [], [], []
    for u in updates:
        tensors = u.param, u.grad.contiguous(), u.exp_avg, u.exp_avg_sq
        if all(t.is_cpu and t.dtype is torch.float32 and t.is_contiguous() for t in tensors):
            width = u.param.numel() // max(len(rows), 1)
            listed.append((*(t.data_ptr() for t in tensors), width, u.lr, u.beta1, u.beta2, u.eps))
            held.append(tensors)  # alive until the call
            done.append(u)
        else:
            left.append(u)
    kind: Any = face.sparse_update * len(listed)
    face.sparse_adam(updates=kind(*listed), count=len(listed), marked=rows.contiguous())
    _written(done)
    return left


def _written(updates: Sequence[AdamUpdate]) -> None:
    """Bump autograd's version counters of tensors that a kernel has written."""
    torch.autograd.graph.increment_version([t for u in updates for t in (u.param, u.exp_avg, u.exp_avg_sq)])
