"""Gaussians drawn of the numbers of splats, as one node of the graph of derivatives: two kernels, matrix products."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sw_wisp.appearance import AppearanceNetwork
from sw_wisp.fast.eight_bits import in_eight_bits
from sw_wisp.fast.kernels import kernels_of
from sw_wisp.numbers import COLOUR, LATENTS
from sw_wisp.splats import Shown

SEEN = slice(COLOUR.columns.start, LATENTS.columns.stop)
"""Columns of what the appearance network sees, colour first; its own weights have the latents first."""


def drawable(values: Tensor, log_edges: Tensor, bounds: tuple[float, float], network: AppearanceNetwork) -> Shown:
    """As `splats.drawable`, where the kernels fit."""
    parameters = network.basis, network.hidden.weight, network.out.weight, network.hidden.bias, network.out.bias
    return Shown(*_Drawable.apply(values, log_edges, bounds, network.rounds, *parameters))  # type: ignore[no-untyped-call]


class _Drawable(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, log_edges: Tensor, bounds: tuple[float, float], rounds: bool, basis: Tensor,
        first: Tensor, last: Tensor, first_bias: Tensor, last_bias: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        values, rows = values.contiguous(), len(values)
        opacities, dc = values.new_empty(rows), values.new_empty(rows, 1, 3)
        covariances, axes = values.new_empty(rows, 6), values.new_empty(rows, 12)
        low, high = bounds
        kernels_of(values).splats(
            values=values, log_edges=log_edges, low=low, high=high, covariances=covariances, opacities=opacities,
            dc=dc.view(rows, 3), axes=axes,
        )  # fmt: skip
        if rounds:
            basis, first, last = in_eight_bits([basis, first, last])
        latents = basis.shape[1]
        first = torch.cat([first[:, latents:], first[:, :latents]], dim=1)
        seen = values[:, SEEN]
        inner = torch.addmm(first_bias, seen, first.t()).relu_()
        rest = torch.addmm(last_bias, inner, last.t()).addmm_(values[:, LATENTS.columns], basis.t())
        ctx.bounds = bounds
        ctx.save_for_backward(values, opacities, axes, inner, basis, first, last)
        ctx.set_materialize_grads(False)
        return opacities, covariances, dc, rest.view(rows, -1, 3)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *slopes: Tensor | None) -> tuple[Tensor | None, ...]:
        values, opacities, axes, inner, basis, first, last = ctx.saved_tensors
        by_opacities, by_covariances, by_dc, by_rest = (
            None if each is None else each.contiguous() for each in slopes
        )  # fmt: skip
        by_colour: Tensor | None = None
        to_network: list[Tensor | None] = [None] * 5
        if by_rest is not None:
            flat, latents = by_rest.view(len(values), -1), values[:, LATENTS.columns]
            to_inner = torch.mm(flat, last)
            torch.ops.aten.threshold_backward.grad_input(to_inner, inner, 0, grad_input=to_inner)
            by_colour = torch.mm(to_inner, first)
            by_colour[:, COLOUR.width :].addmm_(flat, basis)
            if any(ctx.needs_input_grad[4:]):
                to_first = torch.mm(to_inner.t(), values[:, SEEN])
                to_first = torch.cat([to_first[:, COLOUR.width :], to_first[:, : COLOUR.width]], dim=1)
                to_network = [
                    torch.mm(flat.t(), latents), to_first, torch.mm(flat.t(), inner), to_inner.sum(0), flat.sum(0)
                ]  # fmt: skip
        to_values = torch.empty_like(values)
        low, high = ctx.bounds
        kernels_of(values).splats_backward(
            low=low, high=high, axes=axes, opacities=opacities, by_covariances=by_covariances,
            by_opacities=by_opacities, by_dc=None if by_dc is None else by_dc.view(-1, 3), by_colour=by_colour,
            to_values=to_values,
        )  # fmt: skip
        return (to_values, None, None, None, *to_network)
