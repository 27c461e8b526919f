"""Context model `channel-mixture`: channels in slices, each with a second Gaussian from the slices before it.

Another context gives mean, scale and weight of a first Gaussian for every channel. One small network per slice sees
these for all channels and the values of the earlier slices of the same row, and gives a second Gaussian; a channel is
coded under the mixture of both. Rows do not depend on one another. Source: HAC++ (arXiv 2501.12255), intra-anchor
context; exact form: the exact mode of the codec library.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn

from sw_codecs.context.integer_mlp import FRACTION, IntegerMlp, to_fixed
from sw_codecs.context.two_layers import two_layers

LEAK = 41
"""Slope of the leaky ReLUs below zero, in 1/4096: near the published 0.01, and the same in integers."""
PARTS = 3
"""Outputs per channel: mean, scale and logit of the weight of its second Gaussian."""


class ChannelMixture(nn.Module):
    """Slices of sizes n_1 .. n_S; for slice i a network sum of n_j<i + context -> hidden, leaky ReLU -> 3 n_i.

    slices      sizes in order
    context     inputs besides the earlier slices, which come first; 0: none, and slice 1 has free numbers, no network
    hidden      width of a network; None: as wide as its outputs
    scale       second scale before training, of every channel

    Numbers are in units of the base step.
    """

    def __init__(
        self,
        slices: Sequence[int],
        *,
        context: int,
        hidden: int | None = 40,
        scale: float = 1.0,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        if not slices or min(slices) < 1:
            raise ValueError(f"slices must be positive sizes, not {list(slices)}")
        self.slices, self.context, self.hidden = tuple(slices), context, hidden
        self.starts = tuple(sum(self.slices[:i]) for i in range(len(self.slices)))
        self.networks = nn.ModuleDict()
        for i, (start, size) in enumerate(zip(self.starts, self.slices, strict=True)):
            if start + context:
                network = two_layers(
                    start + context, hidden or PARTS * size, PARTS * size, generator,
                    activation=nn.LeakyReLU(LEAK / (1 << FRACTION)),
                )  # fmt: skip
                with torch.no_grad():
                    cast(nn.Linear, network[2]).bias[size : 2 * size] = scale
                self.networks[f"slice{i}"] = network
        self.first: nn.Parameter | None = None
        if not context:
            free = torch.zeros(PARTS, self.slices[0])
            free[1] = scale
            self.first = nn.Parameter(free)

    @staticmethod
    def count(slices: Sequence[int], *, context: int, hidden: int | None) -> int:
        """Numbers of all networks, without making them; arguments as of the constructor."""
        found, start = 0, 0
        for size in slices:
            inputs, outputs = start + context, PARTS * size
            width = hidden or outputs
            found += (inputs + 1) * width + (width + 1) * outputs if inputs else outputs
            start += size
        return found

    def part(self, index: int) -> slice:
        """Columns of slice `index`."""
        return slice(self.starts[index], self.starts[index] + self.slices[index])

    def width(self, index: int) -> int:
        """Most numbers that a row has on its way through `slice`."""
        outputs = PARTS * self.slices[index]
        return max(self.starts[index] + self.context, self.hidden or outputs, outputs)

    def forward(self, values: Tensor, context: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Second (mean, scale, logit) [n, F] of all channels; scales may be negative.

        values      [n, F] noisy in training, dequantised otherwise
        context     [n, context]
        """
        found = [self.slice(i, values[:, : self.starts[i]], context).chunk(PARTS, dim=1)
                 for i in range(len(self.slices))]  # fmt: skip
        mean, scale, logit = (torch.cat(parts, dim=1) for parts in zip(*found, strict=True))
        return mean, scale, logit

    def slice(self, index: int, known: Tensor, context: Tensor) -> Tensor:
        """Means, scales and logits of one slice side by side, [n, 3 n_i].

        known       [n, starts[i]] values of the earlier slices
        """
        if f"slice{index}" not in self.networks:
            assert self.first is not None
            return self.first.reshape(1, -1).expand(len(known), -1)
        found: Tensor = self.networks[f"slice{index}"](torch.cat([known, context], dim=1) if self.context else known)
        return found

    def exact(self) -> ExactChannelMixture:
        """The same in integers. Raises ValueError if a network cannot be evaluated exactly."""
        return ExactChannelMixture(self)


class ExactChannelMixture:
    """A ChannelMixture in integers with 12 fractional bits, the same on every machine; activations within +-256."""

    def __init__(self, model: ChannelMixture) -> None:
        self._context = model.context
        self._first = None
        if model.first is not None:
            free = model.first.detach().cpu()
            if not bool(torch.isfinite(free).all()) or float(free.abs().max()) > 1 << 20:
                raise ValueError("the free numbers of the first slice are not finite, or too large")
            self._first = torch.from_numpy(to_fixed(free.numpy().reshape(-1)))
        self._networks = {
            name: IntegerMlp([_arrays(network[i]) for i in (0, 2)], leak=LEAK)
            for name, network in model.networks.items()
        }

    def slice(self, index: int, known: Tensor, context: Tensor) -> Tensor:
        """As `ChannelMixture.slice`, int64 throughout."""
        if f"slice{index}" not in self._networks:
            assert self._first is not None
            return self._first.expand(len(known), -1)
        return self._networks[f"slice{index}"](known, context if self._context else None)


def _arrays(layer: nn.Module) -> tuple:
    assert isinstance(layer, nn.Linear)
    return layer.weight.detach().cpu().numpy(), layer.bias.detach().cpu().numpy()
