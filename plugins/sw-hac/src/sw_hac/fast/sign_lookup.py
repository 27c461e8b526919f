"""Lookup of signs in hash grids by kernels of sw-codecs, all grids in one node of the graph of derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatwizard_native import fast_enabled
from sw_codecs.context.fast.grid_lookup import MAX_FEATURES, levels_of
from sw_codecs.context.fast.ordered_sums import largest_for_sums
from sw_codecs.context.hash_grid import HashGrid
from sw_codecs.fast import kernel_operations
from sw_codecs.fast.kernel_operations import MAX_LEVELS, Levels
from sw_codecs.native import CODECS

Parts = Sequence[tuple[tuple[int, ...], HashGrid]]


def fits(parts: Parts, x: Tensor) -> bool:
    """Return whether there are kernels for grids of signs and float32 places on the device of `x`; loads them."""
    grids = [grid for _, grid in parts]
    if not fast_enabled() or any(len(grid.levels) > MAX_LEVELS or grid.features > MAX_FEATURES for grid in grids):
        return False
    if x.dtype != torch.float32 or any(grid.table.dtype != torch.float32 for grid in grids):
        return False
    return CODECS.has_cuda() if x.is_cuda else x.device.type == "cpu" and CODECS.try_load()


def with_bits(parts: Parts, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return what `mixed_grid.with_bits` returns, where it `fits`; not differentiable for x."""
    grids = [(axes, levels_of(grid)) for axes, grid in parts]
    features, bits = _SignLookup.apply(x.detach().contiguous(), grids, *(grid.table for _, grid in parts))  # type: ignore[no-untyped-call]
    return features, bits


def _bits_of_signs(positive: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """(bits of signs under their own share of ones, as of `rates.mask_bits`; how much dearer a one is), scalars."""
    ones = positive.sum(dtype=dtype)
    share = (ones / positive.numel()).clamp(1e-6, 1 - 1e-6)
    one, zero = -torch.log2(share), -torch.log2(1 - share)  # bits of each
    return ones * one + (positive.numel() - ones) * zero + 32, one - zero


class _SignLookup(torch.autograd.Function):
    """Features and bits by kernels, which work out corners again instead of keeping them.

    The tables get a straight-through gradient within [-1,1], as of `SteBinary`, and that of `rates.mask_bits`.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, grids: list[tuple[tuple[int, ...], Levels]], *tables: Tensor
    ) -> tuple[Tensor, ...]:
        table = torch.cat(tables)
        bits, dearer = _bits_of_signs(table >= 0, table.dtype)
        ctx.save_for_backward(x, table, dearer)
        ctx.grids, ctx.sizes = grids, [len(t) for t in tables]
        return look_up_signs(x, grids, tables), bits

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_features: Tensor, to_bits: Tensor) -> tuple[Tensor | None, ...]:
        x, table, dearer = ctx.saved_tensors
        total = torch.zeros_like(table)
        add_sign_gradients(x, ctx.grids, to_features, total.split(ctx.sizes))
        return None, None, *_through_signs(total, table, to_bits * dearer).split(ctx.sizes)


def _through_signs(total: Tensor, table: Tensor, to_ones: Tensor) -> Tensor:
    """Gradient of learned numbers from those of their signs, in place, and of the number of positive ones."""
    total += to_ones / 2  # a sign is twice its bit, less one
    total *= table.abs() <= 1
    return total


def look_up_signs(x: Tensor, grids: Sequence[tuple[tuple[int, ...], Levels]], tables: Sequence[Tensor]) -> Tensor:
    """Features [n, width] of places x [n,3] in grids of signs, one after the other; no gradient.

    grids   of each: the columns of x that are its axes, and its levels
    tables  of each: learned numbers [entries, features]
    """
    features = tables[0].shape[1]
    found = x.new_empty(len(x), features * sum(len(levels[0]) for _, levels in grids))
    first = 0
    for (axes, levels), table in zip(grids, tables, strict=True):
        kernel_operations.signs_lookup(x, axes, table, found, first, *levels)
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
        kernel_operations.signs_backward(x, axes, table, to_features, first, *levels, largest=largest)
        first += table.shape[1] * len(levels[0])
