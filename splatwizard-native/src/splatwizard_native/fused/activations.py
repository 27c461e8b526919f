"""The activations of a model of Gaussians: one kernel for both on CUDA, torch operations everywhere else."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_native.fused.native import TRAINING


def activated(log_scales: Tensor, opacity_logits: Tensor) -> tuple[Tensor, Tensor]:
    """Return (exp of the log scales, sigmoid of the opacity logits), differentiable.

    Both of any shape, in float32 on one GPU for the kernel, whose values are those of torch to the last bit but one.
    """
    both = log_scales, opacity_logits
    if all(t.is_cuda and t.dtype == torch.float32 for t in both) and TRAINING.has_cuda():
        found: tuple[Tensor, Tensor] = torch.ops.splatwizard_training.activate(*both)
        return found
    return torch.exp(log_scales), torch.sigmoid(opacity_logits)
