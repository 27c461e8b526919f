"""Compiled sparse Adam: one call for all parameters, on CUDA one launch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from splatwizard_native import AdamUpdate
from sw_gaussians import cuda_face, face
from sw_gaussians.native import GAUSSIANS

MOST_WIDTH = 1 << 20  # numbers of a row that the kernel on CUDA takes


def left_of(updates: Sequence[AdamUpdate], rows: Tensor) -> list[AdamUpdate]:
    """Run the updates that a kernel supports, for the marked rows [N] bool; return the others."""
    if not updates or not (GAUSSIANS.has_cuda() if rows.is_cuda else rows.is_cpu and GAUSSIANS.try_load()):
        return list(updates)
    operations, alignment = (cuda_face, 16) if rows.is_cuda else (face, 1)
    listed, held, left = [], [], []
    for u in updates:
        tensors = u.param, u.grad.contiguous(), u.exp_avg, u.exp_avg_sq
        width = u.param.numel() // max(len(rows), 1)
        if all(_fits(t, rows, alignment) for t in tensors) and width < MOST_WIDTH:
            listed.append((*(t.data_ptr() for t in tensors), width, u.lr, u.beta1, u.beta2, u.eps))
            held.append(tensors)  # alive until the call
        else:
            left.append(u)
    kind: Any = operations.sparse_update * len(listed)
    operations.sparse_adam(updates=kind(*listed), count=len(listed), marked=rows.contiguous())
    torch.autograd.graph.increment_version([t for param, _, *moments in held for t in (param, *moments)])
    return left


def _fits(t: Tensor, rows: Tensor, alignment: int) -> bool:
    """Whether a kernel takes a tensor: float32 without gaps, where the marks are and with a row for each of them."""
    return (
        t.dtype is torch.float32
        and t.device == rows.device
        and t.is_contiguous()
        and t.shape[:1] == rows.shape
        and t.data_ptr() % alignment == 0
    )
