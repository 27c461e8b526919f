"""Lookup in hash grids by a compiled kernel, which works out corners again instead of keeping them.

Without one a faster gradient of the weighted sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from splatwizard_native import fast_enabled
from sw_codecs.context.fast.ordered_sums import largest_for_sums
from sw_codecs.fast import kernel_operations
from sw_codecs.fast.kernel_operations import MAX_LEVELS, Levels
from sw_codecs.native import CODECS

MAX_FEATURES = 8
"""`kMaxFeatures` of kernels/grid.h."""


class Grid(Protocol):
    """Members of a HashGrid that its lookup reads."""

    binary: bool
    features: int
    log2_size: int

    @property
    def levels(self) -> Sequence[Any]:
        """Its levels."""
        ...


def fits(grid: Grid, x: Tensor, values: Tensor) -> bool:
    """Whether there is a kernel for this: float32, numbers and not signs, no gradient for x; loads it."""
    if not fast_enabled() or grid.binary or len(grid.levels) > MAX_LEVELS or grid.features > MAX_FEATURES:
        return False
    if x.dtype != torch.float32 or values.dtype != torch.float32 or x.device != values.device:
        return False
    if x.requires_grad and torch.is_grad_enabled():
        return False
    return CODECS.has_cuda() if x.is_cuda else x.device.type == "cpu" and CODECS.try_load()


def lookup(grid: Grid, x: Tensor, values: Tensor) -> Tensor:
    """Features [n, width] of places [n,d]; differentiable for the values [entries, features].

    Gradients are sums in the order of the places on the CPU, for any number of threads; on CUDA they are atomic, and
    the same in any order where torch is asked for deterministic algorithms.
    """
    found: Tensor = _Lookup.apply(values, x.detach().contiguous(), grid)  # type: ignore[no-untyped-call]
    return found


def weighted_rows(values: Tensor, index: Tensor, weights: Tensor, levels: int) -> Tensor:
    """Return what `hash_grid.weighted_rows` returns, with a backward that takes a seventh of its time.

    The gradient is summed level by level, to bound memory.
    """
    found: Tensor = _WeightedRows.apply(values, index, weights, levels)  # type: ignore[no-untyped-call]
    return found


def levels_of(grid: Grid) -> Levels:
    """The levels of a grid."""
    levels = grid.levels
    return (
        [level.scale for level in levels],
        [level.resolution - 1 for level in levels],
        [level.start for level in levels],
        [int(level.dense) for level in levels],
        grid.log2_size,
    )


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, x: Tensor, grid: Grid) -> Tensor:
        ctx.save_for_backward(x)
        ctx.shape, ctx.levels = values.shape, levels_of(grid)
        found: Tensor = kernel_operations.lookup(x, values.contiguous(), *ctx.levels)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        found = kernel_operations.backward(
            x, gradient.contiguous(), *ctx.shape, *ctx.levels, largest=largest_for_sums(gradient)
        )
        return found, None, None


class _WeightedRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, index: Tensor, weights: Tensor, levels: int) -> Tensor:
        ctx.save_for_backward(values, index, weights)
        ctx.levels = levels
        return F.embedding_bag(index, values, per_sample_weights=weights, mode="sum")

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        values, index, weights = ctx.saved_tensors
        features = values.shape[1]
        for_values = for_weights = None
        if ctx.needs_input_grad[0]:
            for_values = torch.zeros_like(values)
            flat, columns = for_values.view(-1), torch.arange(features, device=index.device)
            for level in range(ctx.levels):
                part = slice(level, None, ctx.levels)
                places = index[part].to(torch.int64)[..., None] * features + columns
                flat.scatter_add_(0, places.reshape(-1), (weights[part, :, None] * grad[part, None]).reshape(-1))
        if ctx.needs_input_grad[2]:
            for_weights = (values[index.to(torch.int64)] * grad[:, None]).sum(dim=2)
        return for_values, None, for_weights, None
