"""Conditions that all kernels of anchors set to their tensors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from splatwizard_native import NativeModule, fast_enabled
from sw_anchors.native import ANCHORS


def fit_kernels(tensor: Tensor, *others: Tensor | None, module: NativeModule = ANCHORS) -> bool:
    """Whether there are kernels for float32 tensors on the device of the first, CPU or CUDA; loads them."""
    if not fast_enabled() or any(t is not None and t.dtype != torch.float32 for t in (tensor, *others)):
        return False
    return module.has_cuda() if tensor.is_cuda else tensor.is_cpu and module.try_load()


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


def zeros_together(shapes: Sequence[tuple[int, ...]], like: Tensor) -> list[Tensor]:
    """Return float32 zeros of the shapes in one allocation, on the device of `like`: one by one each is a launch."""
    counts = [math.prod(shape) for shape in shapes]
    starts = list(itertools.accumulate(((count + 31) // 32 * 32 for count in counts), initial=0))  # 128 bytes
    whole = like.new_zeros(starts[-1], dtype=torch.float32)
    return [whole[at : at + count].view(shape) for at, count, shape in zip(starts, counts, shapes, strict=False)]


def room_for_gaussians(count: int, like: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return memory for means, opacities, scales, quaternions and colours, with dtype and device of `like`."""
    new = like.new_empty
    return new(count, 3), new(count), new(count, 3), new(count, 4), new(count, 3)
