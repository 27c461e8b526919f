"""Context model `channel-ar`: channels in slices, each predicted better by the slices before it.

What another context says of mean and scale of a slice is refined by a small network that sees the decoded values of the
earlier slices of the same row; rows do not depend on one another. Further attributes may be refined by all slices.
Source: CAT-3DGS (arXiv 2503.00357), channel-wise model; exact form: the exact mode of the codec library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from sw_codecs.context.integer_mlp import IntegerMlp
from sw_codecs.context.two_layers import two_layers


class ChannelAr(nn.Module):
    """Slices of sizes n_1 .. n_S; for slice i >= 2 a network sum of n_j<i -> hidden, ReLU -> 2 n_i.

    slices      sizes in order
    refined     further attribute -> how many values a row it has: a network from all slices -> 2 n for each
    The last layers start at zero: before training nothing is refined.
    """

    def __init__(
        self,
        slices: Sequence[int] = (5, 10, 15, 20),
        refined: Mapping[str, int] | None = None,
        *,
        hidden: int = 100,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if not slices or min(slices) < 1:
            raise ValueError(f"slices must be positive sizes, not {list(slices)}")
        self.slices, self.refined = tuple(slices), dict(refined or {})
        self.starts = tuple(sum(self.slices[:i]) for i in range(len(self.slices)))
        self.networks = nn.ModuleDict()
        for name, inputs, outputs in self.sizes():
            self.networks[name] = two_layers(inputs, hidden, 2 * outputs, generator, start="silent")

    def sizes(self) -> list[tuple[str, int, int]]:
        """(name, inputs, values predicted) of each network: "slice1", "slice2", ..., then the refined attributes."""
        pairs = zip(self.starts[1:], self.slices[1:], strict=True)
        found = [(f"slice{i}", start, size) for i, (start, size) in enumerate(pairs, 1)]
        return found + [(name, sum(self.slices), size) for name, size in self.refined.items()]

    def part(self, index: int) -> slice:
        """Columns of slice `index`."""
        return slice(self.starts[index], self.starts[index] + self.slices[index])

    def forward(self, values: Tensor, mean: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Refined (mean, scale) [n, F] of all slices; values [n, F] are noisy in training, dequantised otherwise."""
        if len(self.slices) == 1:
            return mean, scale
        networks = [cast(nn.Sequential, self.networks[f"slice{i}"]) for i in range(1, len(self.slices))]
        parameters = [p for net in networks for layer in (net[0], net[2]) for p in (layer.weight, layer.bias)]
        refined: tuple[Tensor, Tensor] = _Refined.apply(self.slices, values, mean, scale, *parameters)  # type: ignore[no-untyped-call]
        return refined

    def refine(self, name: str, values: Tensor, mean: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Refined (mean, scale) [n, m] of a further attribute, from the values [n, F] of all slices."""
        shift, widening = self.networks[name](values).chunk(2, dim=1)
        return mean + shift, scale + widening

    def exact(self, output_scale: Mapping[str, float] | None = None) -> dict[str, IntegerMlp]:
        """The networks in integers by name: inputs [n, k] and outputs [n, 2 m] (shift of mean, of scale) have 12
        fractional bits; outputs are in units of 1 / output_scale (1 unless given)."""
        units = output_scale or {}
        return {
            name: IntegerMlp.from_module(network, output_scale=units.get(name, 1.0))
            for name, network in self.networks.items()
        }


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
