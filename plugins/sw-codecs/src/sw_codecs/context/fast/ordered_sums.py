"""Sums of gradients on a GPU that are the same in any order, asked for by `torch.use_deterministic_algorithms`."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def largest_for_sums(gradient: Tensor) -> Tensor | None:
    """Return the largest magnitude of `gradient`, a float32 scalar there; None where kernels may sum in any order.

    With it kernels sum whole numbers, in a unit that follows from it (kernels/cuda/sums.h). On a CPU sums always have
    one order.
    """
    if not (gradient.is_cuda and torch.are_deterministic_algorithms_enabled()):
        return None
    if not gradient.numel():
        return gradient.new_zeros(())
    largest: Tensor = torch.linalg.vector_norm(gradient, ord=math.inf)
    return largest
