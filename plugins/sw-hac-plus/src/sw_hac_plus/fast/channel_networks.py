"""Networks of a ChannelMixture as two products: one for all first layers, one a slice for the last ones.

Weights and biases stand in one row of numbers, with zeros where a slice must not look. A hidden number of each slice is
always 1, so that biases are weights: their gradients come out of the products too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, nn

from sw_codecs.context.integer_mlp import FRACTION
from sw_hac_plus.channel_mixture import LEAK, PARTS, ChannelMixture

UNIT = 4
"""Widths of matrices are multiples of it, so that GPUs read 16 bytes at once."""
CONSTANTS = (0.0, 1.0)
"""Contents before the parameters."""


@dataclass(frozen=True)
class _Slice:
    """Columns of a slice in the hidden layer and in the outputs, and where its last weights start."""

    hidden: slice
    outputs: slice
    start: int


class ChannelNetworks:
    """Places of the parameters of a ChannelMixture, of which it holds none.

    columns     [3,F] int32: columns of mean, scale and logit of each channel in the outputs [S,3F]; each column once

    Inputs are F values, 3F numbers of context if there is any, 1, and zeros up to `inputs`.
    """

    def __init__(self, channel: ChannelMixture, device: torch.device) -> None:
        features = sum(channel.slices)
        self.context = channel.context > 0
        if channel.context not in (0, PARTS * features):
            raise ValueError(f"a context of {channel.context} numbers for {features} features is not offered")
        taken = features + channel.context
        self.inputs = _padded(taken + 1)
        self._shapes = [p.shape for p in self.parameters(channel)]
        widths = [_padded(self._hidden(channel, i) + 1) for i in range(len(channel.slices))]
        numbers = iter(self._numbered())
        first = torch.zeros(sum(widths), self.inputs, dtype=torch.int64)
        last, self._slices, row, start = [], [], 0, first.numel()
        columns = torch.full((PARTS, features), -1, dtype=torch.int32)
        for i, (own, size, width) in enumerate(zip(channel.starts, channel.slices, widths, strict=True)):
            hidden = self._hidden(channel, i)
            found = torch.zeros(PARTS * size, width, dtype=torch.int64)
            if hidden:
                weight = next(numbers)
                first[row : row + hidden, :own] = weight[:, :own]
                first[row : row + hidden, features:taken] = weight[:, own:]
                first[row : row + hidden, taken] = next(numbers)
                found[:, :hidden] = next(numbers)
            found[:, hidden] = next(numbers).flatten()
            first[row + hidden, taken] = 1
            outputs = slice(PARTS * own, PARTS * (own + size))
            columns[:, own : own + size] = torch.arange(outputs.start, outputs.stop).view(PARTS, size)
            self._slices.append(_Slice(slice(row, row + width), outputs, start))
            last.append(found.flatten())
            row, start = row + width, start + found.numel()
        # Kernels read and write where the columns point, and on a GPU nobody could look at them without a wait.
        if columns.flatten().sort().values.tolist() != list(range(PARTS * features)):
            raise ValueError(f"slices {list(channel.slices)} at {list(channel.starts)} are not the channels, each once")
        sources = torch.cat([first.flatten(), *last])
        self._first = first.shape
        self._sources, self.columns = sources.to(device), columns.to(device)
        self._places = self._places_of(sources).to(device)
        self._constants = torch.tensor(CONSTANTS).to(device)

    def check_for(self, features: int, device: torch.device) -> None:
        """Raise ValueError unless the networks are of so many features, and on that device."""
        own, where = self.columns.shape[1], self.columns.device
        if (own, where) != (features, device):
            raise ValueError(f"networks of {own} channels on {where} are not for {features} features on {device}")

    @staticmethod
    def parameters(channel: ChannelMixture) -> list[nn.Parameter]:
        """Its parameters, in the order of the slices."""
        networks = cast("dict[str, nn.Module]", dict(channel.networks))
        found = [] if channel.first is None else [channel.first]
        return found + [p for network in networks.values() for p in network.parameters()]

    @staticmethod
    def _hidden(channel: ChannelMixture, index: int) -> int:
        """Width of the hidden layer of a slice; 0: its numbers are free."""
        if f"slice{index}" not in channel.networks:
            return 0
        return channel.hidden or PARTS * channel.slices[index]

    def _numbered(self) -> list[Tensor]:
        """Tensors like the parameters: where each number stands in all of them, behind the constants."""
        found, start = [], len(CONSTANTS)
        for shape in self._shapes:
            found.append(torch.arange(start, start + shape.numel()).view(shape))
            start += shape.numel()
        return found

    def _places_of(self, sources: Tensor) -> Tensor:
        """Index of each number of the parameters among the packed ones; each parameter starts at a UNIT."""
        places = torch.zeros(int(sources.max()) + 1, dtype=torch.int64)
        places[sources] = torch.arange(len(sources))
        padded = [torch.zeros(_padded(each.numel()), dtype=torch.int64) for each in self._numbered()]
        for to, numbers in zip(padded, self._numbered(), strict=True):
            to[: numbers.numel()] = places[numbers.flatten()]
        return torch.cat(padded)

    def packed(self, parameters: tuple[Tensor, ...]) -> Tensor:
        """All weights in a row, of `parameters`."""
        constants = self._constants.to(parameters[0].dtype)
        return torch.cat([constants, *(p.reshape(-1) for p in parameters)]).index_select(0, self._sources)

    def unpacked(self, packed: Tensor, factor: Tensor) -> list[Tensor]:
        """Numbers of each parameter among packed ones, times a scalar."""
        taken = packed.index_select(0, self._places).mul_(factor)
        sizes = [_padded(shape.numel()) for shape in self._shapes]
        parts = zip(torch.split(taken, sizes), self._shapes, strict=True)
        return [part[: shape.numel()].view(shape) for part, shape in parts]

    def forward(self, packed: Tensor, inputs: Tensor) -> tuple[Tensor, Tensor]:
        """(hidden layers, outputs [S,3F]) for inputs [S, `inputs`]."""
        hidden = torch.mm(inputs, self._first_of(packed).t())
        torch.nn.functional.leaky_relu_(hidden, LEAK / (1 << FRACTION))
        outputs = hidden.new_empty(len(hidden), self._slices[-1].outputs.stop)
        for part in self._slices:
            torch.mm(hidden[:, part.hidden], self._last_of(packed, part).t(), out=outputs[:, part.outputs])
        return hidden, outputs

    def backward(self, packed: Tensor, inputs: Tensor, hidden: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients by inputs and packed weights from those by the outputs."""
        to_hidden, to_packed = torch.empty_like(hidden), torch.empty_like(packed)
        for part in self._slices:
            own = slopes[:, part.outputs]
            torch.mm(own, self._last_of(packed, part), out=to_hidden[:, part.hidden])
            torch.mm(own.t(), hidden[:, part.hidden], out=self._last_of(to_packed, part))
        slope = LEAK / (1 << FRACTION)
        torch.ops.aten.leaky_relu_backward.grad_input(to_hidden, hidden, slope, True, grad_input=to_hidden)
        torch.mm(to_hidden.t(), inputs, out=self._first_of(to_packed))
        return torch.mm(to_hidden, self._first_of(packed)), to_packed

    def _first_of(self, packed: Tensor) -> Tensor:
        return packed[: self._first.numel()].view(self._first)

    @staticmethod
    def _last_of(packed: Tensor, part: _Slice) -> Tensor:
        rows, columns = part.outputs.stop - part.outputs.start, part.hidden.stop - part.hidden.start
        return packed[part.start : part.start + rows * columns].view(rows, columns)


def _padded(count: int) -> int:
    return -(-count // UNIT) * UNIT
