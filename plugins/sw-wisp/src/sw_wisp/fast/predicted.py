"""Forecasts of the context networks as one node of the graph of derivatives, and the bits under them as another.

Operators, not arithmetic, limit a training step: plain, all parts of all blocks are some 700 of them. Here a network is
two matrix products, and what stands between them is a kernel for each block. The way back is one kernel for all blocks,
since what networks are told of blocks before them is a constant.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from sw_wisp.eight_bits import EXACT_EXPONENT
from sw_wisp.fast.eight_bits import in_eight_bits
from sw_wisp.fast.kernels import kernels_of
from sw_wisp.numbers import BLOCKS, NUMBERS
from sw_wisp.rate import Forecast
from sw_wisp.rounding import AS_THEY_ARE, FINAL, FLOAT, HARD, NOISE, SOFT, Rounding
from sw_wisp.ties import tied_parts

PHASES = {FLOAT: 0, FINAL: 0, NOISE: 1, SOFT: 2, HARD: 3}
FEATURES, KNOWN = 69, BLOCKS[-1].start
OUTPUTS = (slice(0, 3), slice(4, 18), slice(20, 27), slice(28, 53))
ALL_OUTPUTS = 56
"""Columns of the networks' outputs, which share a matrix, as hidden numbers do. All begin at multiples of 16 bytes, as
the optimizer's kernel asks of gradients."""
TOLD = (slice(0, 0), slice(0, 12), slice(12, 18), slice(18, 42))
"""Columns of what ties follow: residuals of a block, then their sizes."""


class Networks(Protocol):
    """Protocol of the `ContextNetworks` members that a step reads."""

    networks: nn.ModuleList
    ties: nn.ParameterList
    base_steps: Tensor
    multipliers: Tensor
    adaptive: bool
    rounds: bool


def predicted(
    networks: Networks,
    features: Tensor,
    view_features: Tensor,
    values: Tensor,
    rounding: Rounding = AS_THEY_ARE,
    *,
    moves_steps: bool = True,
) -> tuple[Forecast, Tensor]:
    """As `ContextNetworks.forward`, where the kernels fit."""
    layers = [layer for network in networks.networks for layer in (network[0], network[-1])]  # type: ignore[index]
    parameters = [layer.weight for layer in layers] + list(networks.ties) + [layer.bias for layer in layers]
    how = rounding, networks.adaptive, moves_steps, networks.rounds
    given = rounding.noise(values), rounding.soft, features, view_features, networks.base_steps, networks.multipliers
    found = _Predicted.apply(values, *given, how, *parameters)  # type: ignore[no-untyped-call]
    mean, scale, steps, drawn = found
    return Forecast(mean, scale, steps), drawn


def bits_of(values: Tensor, forecast: Forecast, last: int | None = None) -> Tensor:
    """As `rate_model.bits_of`, where the kernels fit."""
    count = len(values) if last is None else last
    found: Tensor = _Bits.apply(values, *forecast, count)  # type: ignore[no-untyped-call]
    return found


class _Predicted(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, values: Tensor, noise: Tensor | None, soft: Tensor | None, features: Tensor, view_features: Tensor,
        base_steps: Tensor, multipliers: Tensor, how: tuple[Rounding, bool, bool, bool], *parameters: Tensor,
    ) -> tuple[Tensor, ...]:  # fmt: skip
        rounding, adaptive, moves_steps, rounds = how
        kernels, rows = kernels_of(values), len(values)
        weights, ties, biases = parameters[:8], parameters[8:13], parameters[13:]
        if rounds:
            rounded = in_eight_bits([*weights, *ties], EXACT_EXPONENT)
            weights, ties = tuple(rounded[:8]), tuple(rounded[8:])
        values = values.contiguous()
        mean, scale, steps, drawn = (torch.empty_like(values) for _ in range(4))
        inputs, view_inputs = (values.new_empty(rows, FEATURES + KNOWN) for _ in range(2))
        inputs[:, :FEATURES].copy_(features)
        view_inputs[:, :FEATURES].copy_(view_features)
        columns = _hidden_columns([len(each) for each in weights[::2]])
        hidden, outputs = values.new_empty(rows, columns[-1].stop), values.new_empty(rows, ALL_OUTPUTS)
        told = values.new_empty(rows, TOLD[-1].stop)
        phase = {"phase": PHASES[rounding.phase], "sharpness": rounding.sharpness, "soft": soft, "adaptive": adaptive}
        for number, block in enumerate(BLOCKS):
            seen = (view_inputs if number == 3 else inputs)[:, : FEATURES + block.start]
            inner, outer = hidden[:, columns[number]], outputs[:, OUTPUTS[number]]
            first, last = 2 * number, 2 * number + 1
            torch.addmm(biases[first], seen, weights[first].t(), out=inner)
            inner.relu_()
            torch.addmm(biases[last], inner, weights[last].t(), out=outer)
            kernels.draw(
                **phase, block=number, values=values, noise=noise, outputs=outputs, inputs=inputs, told=told,
                view_inputs=view_inputs, base_steps=base_steps, multipliers=multipliers, ties=ties,
                mean=mean, scale=scale, steps=steps, drawn=drawn,
            )  # fmt: skip
        ctx.phase, ctx.moves_steps, ctx.has_noise, ctx.columns = phase, moves_steps, noise is not None, columns
        saved = [values, base_steps, mean, steps, inputs, view_inputs, hidden, outputs, told, *weights[1::2]]
        ctx.save_for_backward(*saved, *([] if noise is None else [noise]))
        ctx.set_materialize_grads(False)
        if not moves_steps:
            ctx.mark_non_differentiable(steps)
        return mean, scale, steps, drawn

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, by_mean: Tensor | None, by_scale: Tensor | None, by_steps: Tensor | None, by_drawn: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        values, base_steps, mean, steps, inputs, view_inputs, hidden, outputs, told, *rest = ctx.saved_tensors
        lasts, noise = rest[:4], rest[4] if ctx.has_noise else None
        to_outputs, to_values = torch.empty_like(outputs), torch.empty_like(values)
        slopes = [None if each is None else each.contiguous() for each in (by_mean, by_scale, by_steps, by_drawn)]
        kernels_of(values).draw_backward(
            **ctx.phase, moves_steps=ctx.moves_steps, values=values, noise=noise, outputs=outputs,
            base_steps=base_steps, mean=mean, steps=steps, by_mean=slopes[0], by_scale=slopes[1], by_steps=slopes[2],
            by_drawn=slopes[3], to_outputs=to_outputs, to_values=to_values,
        )  # fmt: skip
        others: list[Tensor | None] = [None] * 7
        if not any(ctx.needs_input_grad[8:]):
            return (to_values, *others, *[None] * 21)
        to_hidden = torch.empty_like(hidden)
        for number, last in enumerate(lasts):
            torch.mm(to_outputs[:, OUTPUTS[number]], last, out=to_hidden[:, ctx.columns[number]])
        torch.ops.aten.threshold_backward.grad_input(to_hidden, hidden, 0, grad_input=to_hidden)
        to_weights: list[Tensor | None] = []
        for number, block in enumerate(BLOCKS):
            seen = (view_inputs if number == 3 else inputs)[:, : FEATURES + block.start]
            to_weights.append(torch.mm(to_hidden[:, ctx.columns[number]].t(), seen))
            to_weights.append(torch.mm(to_outputs[:, OUTPUTS[number]].t(), hidden[:, ctx.columns[number]]))
        inner, outer = to_hidden.sum(0), to_outputs.sum(0)
        to_biases = [each for h, o in zip(ctx.columns, OUTPUTS, strict=True) for each in (inner[h], outer[o])]
        to_ties = _to_ties(torch.mm(to_outputs.t(), told))
        return (to_values, *others, *to_weights, *to_ties, *to_biases)


def _hidden_columns(widths: Sequence[int]) -> list[slice]:
    """Columns of the hidden numbers of each network; widths are multiples of 4."""
    return [slice(end - width, end) for width, end in zip(widths, itertools.accumulate(widths), strict=True)]


def _to_ties(products: Tensor) -> list[Tensor]:
    """Gradients of the ties from sums [56,42] of outputs' gradients times what ties follow."""
    places, shapes, starts = _tie_places(products.device)
    found = products.view(-1).index_select(0, places)
    return [
        found[start : start + rows * columns].view(rows, columns)
        for (rows, columns), start in zip(shapes, starts, strict=True)
    ]


@functools.cache
def _tie_places(device: torch.device) -> tuple[Tensor, Sequence[tuple[int, int]], Sequence[int]]:
    """Places of each tied weight's gradient among those products, shapes of ties, and where they begin."""
    table = torch.arange(ALL_OUTPUTS * TOLD[-1].stop).view(ALL_OUTPUTS, -1)
    parts, shapes, starts, length = [], [], [], 0
    for part, before in tied_parts():
        number, block = next((n, b) for n, b in enumerate(BLOCKS) if b.start <= part.start < b.stop)
        width, out, told = block.stop - block.start, OUTPUTS[number].start, TOLD[number].start
        rows = slice(part.start - block.start, part.stop - block.start)
        columns = before.stop - before.start
        found = [
            table[out + apart + rows.start : out + apart + rows.stop, told + apart : told + apart + columns]
            for apart in (0, width)  # of means and residuals; of scale levels and sizes
        ]
        flat = torch.cat(found).flatten()
        parts.append(torch.cat([flat, flat.new_zeros(-len(flat) % 4)]))  # gradients begin at multiples of 16 bytes
        shapes.append((2 * (rows.stop - rows.start), columns))
        starts.append(length)
        length += len(parts[-1])
    return torch.cat(parts).to(device), shapes, starts


class _Bits(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, mean: Tensor, scale: Tensor, steps: Tensor, last: int) -> Tensor:
        given = {"values": values, "mean": mean, "scale": scale, "steps": steps}
        given = {name: each.contiguous() for name, each in given.items()}
        bits = values.new_empty(last, NUMBERS)
        kernels_of(values).bits(**given, last=last, bits=bits)
        ctx.save_for_backward(*given.values())
        return bits

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_bits: Tensor) -> tuple[Tensor | None, ...]:
        values, mean, scale, steps = ctx.saved_tensors
        found = [torch.empty_like(values) for _ in range(4)]
        names = ("to_values", "to_mean", "to_scale", "to_steps")
        kernels_of(values).bits_backward(
            values=values, mean=mean, scale=scale, steps=steps, by_bits=by_bits.contiguous(),
            **dict(zip(names, found, strict=True)),
        )  # fmt: skip
        return *(each if needed else None for each, needed in zip(found, ctx.needs_input_grad, strict=False)), None
