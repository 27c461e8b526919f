"""Refinement of the features by all slices as one node of the graph; plain form: `ChannelAr`."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from sw_cat_3dgs.channel_ar import ChannelAr


def refined(model: ChannelAr, values: Tensor, mean: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
    """Refined (mean, scale) [n, F] of all slices, as of a call of `model`."""
    if len(model.slices) == 1:
        return mean, scale
    networks = [cast(nn.Sequential, model.networks[f"slice{i}"]) for i in range(1, len(model.slices))]
    parameters = [p for net in networks for layer in (net[0], net[2]) for p in (layer.weight, layer.bias)]
    found: tuple[Tensor, Tensor] = _Refined.apply(model.slices, values, mean, scale, *parameters)  # type: ignore[no-untyped-call]
    return found


class _Refined(torch.autograd.Function):
    """Mean and scale [n, F] plus what the slices' networks say of them, as one node of the graph.

    Parameters: weight and bias of both layers of each network.
    """

    @staticmethod
    def forward(
        ctx: Any, slices: tuple[int, ...], values: Tensor, mean: Tensor, scale: Tensor, *parameters: Tensor
    ) -> tuple[Tensor, Tensor]:
        start, hidden, shifts = 0, [], []
        for size, i in zip(slices, range(0, len(parameters), 4), strict=False):
            start += size
            weight, bias, last, last_bias = parameters[i : i + 4]
            hidden.append(torch.addmm(bias, values[:, :start], weight.t()).relu_())
            shifts.append(torch.addmm(last_bias, hidden[-1], last.t()).chunk(2, dim=1))
        ctx.save_for_backward(values, *hidden, *parameters[0::4], *parameters[2::4])
        ctx.slices = slices
        none = [mean.new_zeros(len(mean), slices[0])]
        first, second = (torch.cat(none + [shift[i] for shift in shifts], dim=1) for i in (0, 1))
        return first.add_(mean), second.add_(scale)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, to_mean: Tensor, to_scale: Tensor) -> tuple[Tensor | None, ...]:
        values, *rest = ctx.saved_tensors
        count = len(ctx.slices) - 1
        to_values = torch.zeros_like(values) if ctx.needs_input_grad[1] else None
        parts = zip(*(torch.split(each, ctx.slices, dim=1)[1:] for each in (to_mean, to_scale)), strict=True)
        start, to_parameters = 0, []
        for size, both, hidden, weight, last in zip(
            ctx.slices, parts, rest[:count], rest[count : 2 * count], rest[2 * count :], strict=False
        ):
            start += size
            out = torch.cat(both, dim=1)
            to_hidden = torch.ops.aten.threshold_backward(torch.mm(out, last), hidden, 0)
            to_parameters += [torch.mm(to_hidden.t(), values[:, :start]), to_hidden.sum(dim=0)]
            to_parameters += [torch.mm(out.t(), hidden), out.sum(dim=0)]
            if to_values is not None:
                to_values[:, :start].addmm_(to_hidden, weight)
        return None, to_values, to_mean, to_scale, *to_parameters
