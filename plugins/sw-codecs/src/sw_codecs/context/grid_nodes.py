"""Lookups in hash grids as nodes of the graph of derivatives, with their gradients written down."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn import functional as F  # noqa: N812 (torch's own name for it)

from sw_codecs.context.grid_lookup import Levels, add_sign_gradients, look_up_signs

SUMMED = 1 << 26
"""Numbers of a gradient that are summed together, at most about so many: bounds memory."""


class WeightedRows(torch.autograd.Function):
    """sum_c weights[b,c] values[index[b,c]]: torch's embedding_bag, with a backward that takes a seventh of its time.

    Bag b belongs to level b % levels; the gradient is summed level by level, to bound memory.
    """

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


def _bits_of_signs(positive: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """(bits of signs under their own share of ones, as of `rates.mask_bits`; how much dearer a one is), scalars."""
    ones = positive.sum(dtype=dtype)
    share = (ones / positive.numel()).clamp(1e-6, 1 - 1e-6)
    one, zero = -torch.log2(share), -torch.log2(1 - share)  # bits of each
    return ones * one + (positive.numel() - ones) * zero + 32, one - zero


class SignLookup(torch.autograd.Function):
    """`BinaryLookup` of places themselves, by kernels: nothing is kept for a place."""

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


class BinaryLookup(torch.autograd.Function):
    """Features [n, width] and the bits of all signs, of a MixedHashGrid at GridPlaces: all its grids in one node.

    The tables get a straight-through gradient within [-1,1], as of `SteBinary`, and that of `rates.mask_bits`.
    """

    @staticmethod
    def forward(
        ctx: Any, space: Tensor, space_weights: Tensor, planes: Tensor, planes_weights: Tensor, *tables: Tensor
    ) -> tuple[Tensor, Tensor]:
        table = torch.cat(tables)
        positive = table >= 0
        signs = positive.to(table.dtype).mul_(2).sub_(1)
        found = [
            F.embedding_bag(i.flatten(0, 1), signs, per_sample_weights=w.flatten(0, 1), mode="sum").view(
                len(i), i.shape[1] * table.shape[1]
            )
            for i, w in ((space, space_weights), (planes, planes_weights))
        ]
        bits, dearer = _bits_of_signs(positive, table.dtype)
        ctx.save_for_backward(space, space_weights, planes, planes_weights, table, dearer)
        ctx.sizes = [len(t) for t in tables]
        return torch.cat(found, dim=1), bits

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_features: Tensor, to_bits: Tensor) -> tuple[Tensor | None, ...]:
        space, space_weights, planes, planes_weights, table, dearer = ctx.saved_tensors
        width = space.shape[1] * table.shape[1]
        total = torch.zeros_like(table)
        for index, weights, part in (
            (space, space_weights, to_features[:, :width]),
            (planes, planes_weights, to_features[:, width:]),
        ):
            _add_weighted_rows(total, index, weights, part.unflatten(1, (index.shape[1], table.shape[1])))
        return None, None, None, None, *_through_signs(total, table, to_bits * dearer).split(ctx.sizes)


def _add_weighted_rows(total: Tensor, index: Tensor, weights: Tensor, grad: Tensor) -> None:
    """total[index] += weights * grad, for index and weights [n,L,c], grad [n,L,F], total [entries,F]; all summed."""
    features = total.shape[1]
    at_once = max(1, SUMMED // max(index[:1].numel() * features, 1))
    columns = None if total.is_cuda else torch.arange(features)
    for i, w, g in zip(index.split(at_once), weights.split(at_once), grad.split(at_once), strict=True):
        source = w[..., None] * g[:, :, None]
        if columns is None:
            total.index_add_(0, i.reshape(-1), source.view(-1, features))
        else:  # on a CPU a seventh of the time of the above
            places = i.to(torch.int64)[..., None] * features + columns
            total.view(-1).scatter_add_(0, places.reshape(-1), source.reshape(-1))
