"""Conditions that the kernels of this package set to their tensors, and where they are."""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from splatwizard_native import fast_enabled
from sw_wisp.fast import cuda_face, face
from sw_wisp.fast.native import WISP


def fit_kernels(*tensors: Tensor) -> bool:
    """Whether there are kernels for float32 tensors on the device of the first, which is that of all; loads them."""
    first = tensors[0]
    if not fast_enabled() or any(t.dtype != torch.float32 or t.device != first.device for t in tensors):
        return False
    return WISP.has_cuda() if first.is_cuda else first.is_cpu and WISP.try_load()


def kernels_of(tensor: Tensor) -> ModuleType:
    """Return the operations on the device of a tensor that fits."""
    return cuda_face if tensor.is_cuda else face
