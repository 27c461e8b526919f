"""Small networks of two layers, as context models and anchors have them, started from a generator of their own."""

from __future__ import annotations

import math
from typing import Literal

import torch
from torch import nn

Start = Literal["fan-in", "xavier", "silent"]


class UnsetLinear(nn.Linear):
    """Linear layer whose numbers nobody has set, nor drawn from the global generator.

    As of nn.utils.skip_init, which imports sympy on its first call: half a second of each process that decodes a file.
    """

    def reset_parameters(self) -> None:
        """Leave weight and bias as they are."""


@torch.no_grad()
def two_layers(
    inputs: int,
    hidden: int,
    outputs: int,
    generator: torch.Generator | None,
    *,
    start: Start = "fan-in",
    activation: nn.Module | None = None,
) -> nn.Sequential:
    """Network inputs -> hidden, activation -> outputs.

    start       "fan-in": all weights and biases uniform within 1/sqrt(fan-in), as torch's default; "silent": so the
                first layer, zeros the last: the network says nothing before training; "xavier": weights uniform within
                sqrt(6 / (fan-in + fan-out)), biases zero
    activation  None: ReLU
    """
    first, last = UnsetLinear(inputs, hidden), UnsetLinear(hidden, outputs)
    for layer in (first, last):
        bound = 1 / math.sqrt(layer.in_features)
        if start == "xavier":
            bound = math.sqrt(6 / (layer.in_features + layer.out_features))
        for parameter in (layer.weight, layer.bias):
            if (start == "silent" and layer is last) or (start == "xavier" and parameter is layer.bias):
                parameter.zero_()
            else:
                parameter.copy_(torch.rand(parameter.shape, generator=generator) * 2 * bound - bound)
    return nn.Sequential(first, nn.ReLU() if activation is None else activation, last)
