"""Lookup in hash grids by a compiled kernel, which works out corners again instead of keeping them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from sw_codecs.context.ordered_sums import largest_for_sums
from sw_codecs.native import CODECS

if TYPE_CHECKING:
    from sw_codecs.context.hash_grid import HashGrid

MAX_LEVELS = 32
MAX_FEATURES = 8
"""`kMaxLevels` and `kMaxFeatures` of kernels/grid.h."""

Levels = tuple[list[float], list[int], list[int], list[int], int]
"""Levels of a grid as the ops take them: scales, last vertices, first entries, whether dense; log2_size."""


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

    Gradients are sums in the order of the places on the CPU, for any number of threads; on CUDA they are atomic, and
    the same in any order where torch is asked for deterministic algorithms.
    """
    found: Tensor = _Lookup.apply(values, x.detach().contiguous(), grid)  # type: ignore[no-untyped-call]
    return found


def levels_of(grid: HashGrid) -> Levels:
    """The levels of a grid."""
    levels = grid.levels
    return (
        [level.scale for level in levels],
        [level.resolution - 1 for level in levels],
        [level.start for level in levels],
        [int(level.dense) for level in levels],
        grid.log2_size,
    )


def signs_fit_kernel(grids: Sequence[HashGrid], like: Tensor) -> bool:
    """Whether there is a kernel for grids of signs and float32 places on the device of `like`; loads it."""
    if any(len(grid.levels) > MAX_LEVELS or grid.features > MAX_FEATURES for grid in grids):
        return False
    if like.dtype != torch.float32 or any(grid.table.dtype != torch.float32 for grid in grids):
        return False
    return CODECS.has_cuda() if like.is_cuda else like.device.type == "cpu" and CODECS.try_load()


def look_up_signs(x: Tensor, grids: Sequence[tuple[tuple[int, ...], Levels]], tables: Sequence[Tensor]) -> Tensor:
    """Features [n, width] of places x [n,3] in grids of signs, one after the other; no gradient.

    grids   of each: the columns of x that are its axes, and its levels
    tables  of each: learned numbers [entries, features]
    """
    features = tables[0].shape[1]
    found = x.new_empty(len(x), features * sum(len(levels[0]) for _, levels in grids))
    first = 0
    for (axes, levels), table in zip(grids, tables, strict=True):
        torch.ops.sw_codecs.signs_lookup(x, axes, table, found, first, *levels)
        first += features * len(levels[0])
    return found


def add_sign_gradients(
    x: Tensor, grids: Sequence[tuple[tuple[int, ...], Levels]], to_features: Tensor, tables: Sequence[Tensor]
) -> None:
    """Add to `tables` the gradients by their signs, from those of the features; arguments as of `look_up_signs`.

    Sums as of `lookup`.
    """
    first, to_features = 0, to_features.contiguous()
    largest = largest_for_sums(to_features)
    for (axes, levels), table in zip(grids, tables, strict=True):
        torch.ops.sw_codecs.signs_backward(x, axes, table, to_features, first, *levels, largest)
        first += table.shape[1] * len(levels[0])


class _Lookup(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, x: Tensor, grid: HashGrid) -> Tensor:
        ctx.save_for_backward(x)
        ctx.shape, ctx.levels = values.shape, levels_of(grid)
        found: Tensor = torch.ops.sw_codecs.lookup(x, values.contiguous(), *ctx.levels)
        return found

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        found = torch.ops.sw_codecs.backward(
            x, gradient.contiguous(), *ctx.shape, *ctx.levels, largest_for_sums(gradient)
        )
        return found, None, None
