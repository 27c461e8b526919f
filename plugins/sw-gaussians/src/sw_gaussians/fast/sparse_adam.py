"""Compiled sparse Adam: one call per parameter on the CPU, one launch for all parameters on CUDA."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatwizard_native import AdamUpdate
from sw_gaussians.native import GAUSSIANS


def left_of(updates: Sequence[AdamUpdate], rows: Tensor) -> list[AdamUpdate]:
    """Run the updates that a kernel supports, for the marked rows [N] bool; return the others."""
    left = list(updates)
    if updates and rows.is_cuda and GAUSSIANS.has_cuda():
        nothing = rows.new_empty(0, dtype=torch.int32)
        undone = torch.ops.splatwizard_gaussians.sparse_adam_many(
            [u.param for u in updates], [u.grad.contiguous() for u in updates],
            [u.exp_avg for u in updates], [u.exp_avg_sq for u in updates],
            [nothing for _ in updates], rows.contiguous(),
            [u.lr for u in updates], [u.beta1 for u in updates], [u.beta2 for u in updates], [u.eps for u in updates],
        )  # fmt: skip
        for u in updates:
            _written(u)
        left = [updates[i] for i in undone]
    return [u for u in left if not _on_the_cpu(u, rows)]


def _on_the_cpu(u: AdamUpdate, rows: Tensor) -> bool:
    """Update one parameter by the kernel of the CPU, if that knows it."""
    floats = (u.param, u.grad.contiguous(), u.exp_avg, u.exp_avg_sq)
    fits = all(t.device.type == "cpu" and t.dtype == torch.float32 and t.is_contiguous() for t in floats)
    if not (fits and GAUSSIANS.try_load()):
        return False
    torch.ops.splatwizard_gaussians.sparse_adam(*floats, rows.contiguous(), None, u.lr, u.beta1, u.beta2, u.eps)
    _written(u)
    return True


def _written(u: AdamUpdate) -> None:
    """Bump autograd's version counters of tensors that a kernel has written."""
    for tensor in (u.param, u.exp_avg, u.exp_avg_sq):
        torch.autograd.graph.increment_version(tensor)
