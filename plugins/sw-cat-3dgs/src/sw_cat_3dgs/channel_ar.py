"""Channel-wise model: features in slices, each predicted better from the slices before it.

What another context says of mean and scale of a slice is refined by a small network that sees the decoded values of the
earlier slices of the same row; rows do not depend on one another. Further attributes may be refined by all slices.
Source: CAT-3DGS (arXiv 2503.00357), channel-wise model; exact form: the exact mode of the codec library.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from sw_codecs.context.integer_mlp import IntegerMlp
from sw_codecs.context.two_layers import two_layers


class ChannelAr(nn.Module):
    """Slices of sizes n_1 .. n_S; for slice i >= 2 a network sum of n_j<i -> hidden, ReLU -> 2 n_i.

    slices      sizes in order
    refined     further attribute -> how many values per row it has: a network from all slices -> 2 n for each
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
        means, scales = [mean[:, self.part(0)]], [scale[:, self.part(0)]]
        for i in range(1, len(self.slices)):
            known, own = values[:, : self.starts[i]], self.part(i)
            refined = self.refine(f"slice{i}", known, mean[:, own], scale[:, own])
            means.append(refined[0])
            scales.append(refined[1])
        return torch.cat(means, dim=1), torch.cat(scales, dim=1)

    def refine(self, name: str, values: Tensor, mean: Tensor, scale: Tensor) -> tuple[Tensor, Tensor]:
        """Refined (mean, scale) [n, m] by the network `name`, from the values [n, k] of the slices that it sees."""
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
