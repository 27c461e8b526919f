"""Lookup in a hash grid of real numbers by a compiled kernel, which works out corners again instead of keeping them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sw_codecs.native import CODECS

if TYPE_CHECKING:
    from sw_codecs.context.hash_grid import HashGrid

MAX_LEVELS = 32
MAX_FEATURES = 8
"""`kMaxLevels` of kernels/grid.h, `kMaxFeatures` of kernels/cuda/kernels.h."""


def fits_kernel(grid: HashGrid, x: Tensor, values: Tensor) -> bool:
    """Whether there is a kernel for this: float32, numbers and not signs, no gradient for x; loads it."""
    if grid.binary or len(grid.levels) > MAX_LEVELS or grid.features > MAX_FEATURES:
        return False
    if x.dtype != torch.float32 or values.dtype != torch.float32 or x.device != values.device:
        return False
    if x.requires_grad and torch.is_grad_enabled():
        return False
    return CODECS.has_cuda() if x.is_cuda else x.device.type == "cpu" and CODECS.try_load()


def lookup(grid: HashGrid, x: Tensor, values: Tensor) -> Tensor:
    """Features [n, width] of places [n,d]; differentiable for the values [entries, features].

    Gradients are sums in the order of the places on the CPU, for any number of threads; on CUDA they are atomic.
    """
    found: Tensor = _Lookup.apply(values, x.detach().contiguous(), grid)  # type: ignore[no-untyped-call]
    return found


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, x: Tensor, grid: HashGrid) -> Tensor:
        ctx.save_for_backward(x)
        ctx.shape, levels = values.shape, grid.levels
        ctx.levels = (
            [level.scale for level in levels],
            [level.resolution - 1 for level in levels],
            [level.start for level in levels],
            [int(level.dense) for level in levels],
            grid.log2_size,
        )
        found: Tensor = torch.ops.sw_codecs.lookup(x, values.contiguous(), *ctx.levels)
        return found

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        return torch.ops.sw_codecs.backward(x, gradient.contiguous(), *ctx.shape, *ctx.levels), None, None
