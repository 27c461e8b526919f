"""Conditions that all kernels of anchors set to their tensors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from splatwizard_native import fast_enabled
from sw_anchors.native import ANCHORS


def fit_kernels(tensor: Tensor, *others: Tensor | None) -> bool:
    """Whether there are kernels for float32 tensors on the device of the first, CPU or CUDA; loads them."""
    if not fast_enabled() or any(t is not None and t.dtype != torch.float32 for t in (tensor, *others)):
        return False
    return ANCHORS.has_cuda() if tensor.is_cuda else tensor.device.type == "cpu" and ANCHORS.try_load()


def without_gaps(
    tensors: Sequence[Tensor | None], strides: Sequence[tuple[int, ...] | None]
) -> tuple[Tensor | None, ...]:
    """Return the tensors, contiguous where their strides behind the first are not those named.

    strides     of each tensor that may be columns of a matrix; None: it has to be contiguous
    """
    return tuple(
        t if t is None or (inner is not None and t.stride()[1:] == inner) else t.contiguous()
        for t, inner in zip(tensors, strides, strict=True)
    )
