"""Context model `spatial-ar`: the distribution of each integer of a plane from its causal neighbours.

A residual network of 1,058 weights looks at twelve neighbours and gives mean and scale of a Laplacian. In training it
runs over whole planes at once; a decoder goes along wavefronts (`plane_coder`), with the network in exact integers.
Source: CAT-3DGS (arXiv 2503.00357), after Cool-Chic (arXiv 2212.05458).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn

from splatwizard_core.api import BitstreamError
from sw_codecs.context.integer_mlp import FRACTION, IntegerMlp
from sw_codecs.context.two_layers import UnsetLinear
from sw_codecs.entropy.exact_tables import LEVELS
from sw_codecs.entropy.further_rates import laplace_bits
from sw_codecs.entropy.rates import lower_bound

NEIGHBORS = (*((-2, right) for right in range(-2, 3)), *((-1, right) for right in range(-2, 3)), (0, -2), (0, -1))
"""(rows down, columns right) of the neighbours, in raster order."""
HIDDEN = 16
RESIDUALS = 3
SMALLEST, LARGEST = 0.05, 64.0
"""Scales of the first and the last table of the coder; those in between are spaced evenly in the logarithm."""
P_MIN = 2.0**-16

# level = 63 ln(b / SMALLEST) / ln(LARGEST / SMALLEST) with ln b = -s / 2, to the nearest: (offset - slope s) >> 28 for
# s with 12 fractional bits. Literals, so that no logarithm of a decoder's machine decides about a level:
# round(63 / (2 ln 1280) 2^16) and round((63 ln 20 / ln 1280 + 1/2) 2^28).
_SLOPE = 288_539
_OFFSET = 7_215_259_165


class SpatialAr(nn.Module):
    """12 -> 16, ReLU; three times 16 -> 16 plus its input, ReLU; 16 -> 2: mean and s, the scale being exp(-s/2)."""

    def __init__(self, generator: torch.Generator | None = None) -> None:
        super().__init__()
        sizes = [(len(NEIGHBORS), HIDDEN), *[(HIDDEN, HIDDEN)] * RESIDUALS, (HIDDEN, 2)]
        self.layers = nn.ModuleList(UnsetLinear(*size) for size in sizes)
        for i, layer in enumerate(self.linear()):
            for parameter in layer.parameters():
                nn.init.zeros_(parameter)
            if i in (0, len(self.layers) - 1):
                drawn = torch.randn(layer.weight.shape, generator=generator)
                with torch.no_grad():
                    layer.weight.copy_(drawn / layer.out_features**2)

    def linear(self) -> list[nn.Linear]:
        """The layers in order."""
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]

    def forward(self, planes: Tensor) -> tuple[Tensor, Tensor]:
        """(mean, s), each of the shape of `planes` [..., H, W]: integers, or integers with noise in training."""
        h, w = planes.shape[-2:]
        padded = nn.functional.pad(planes.reshape(-1, h, w), (2, 2, 2, 0))
        around = [padded[:, 2 + down : 2 + down + h, 2 + right : 2 + right + w] for down, right in NEIGHBORS]
        a = torch.stack([each.flatten() for each in around])  # [12, n]: one column a value, so weights come first
        last = len(self.layers) - 1
        for i, layer in enumerate(self.linear()):
            out = torch.addmm(layer.bias[:, None], layer.weight, a)
            a = out if i == last else torch.relu(out + a if i > 0 else out)
        mean, s = a.view(2, *planes.shape)
        return mean, s

    def bits(self, planes: Tensor) -> Tensor:
        """Bits of each value of `planes` [..., H, W], which are their own context; differentiable.

        Scales are kept to those that the coder has; the gradient that would bring one back passes.
        """
        mean, s = self(planes)
        s = lower_bound(s, -2 * math.log(LARGEST))
        s = -lower_bound(-s, 2 * math.log(SMALLEST))
        return laplace_bits(planes, mean, torch.exp(-0.5 * s), p_min=P_MIN)

    def exact(self) -> ExactSpatialAr:
        """The integer form, for the file. Raises BitstreamError for weights that have none."""
        return ExactSpatialAr(self)


def plane_bits(networks: Sequence[SpatialAr], planes: Sequence[Tensor]) -> Tensor:
    """Bits of all values of planes [K, C, H, W] per scale, orientation k under networks[k]; a differentiable scalar."""
    parts = [network.bits(part).sum() for plane in planes for network, part in zip(networks, plane, strict=True)]
    return torch.stack(parts).sum()


class ExactSpatialAr:
    """The network of a file in integers: means and table levels do not depend on device or batch."""

    def __init__(self, network: SpatialAr) -> None:
        weights = []
        for i, layer in enumerate(network.linear()):
            weight, bias = (each.detach().cpu().numpy() for each in (layer.weight, layer.bias))
            skip = np.eye(HIDDEN, dtype=np.float32) if 0 < i <= RESIDUALS else np.float32(0)
            weights.append((weight + skip, bias))  # the identity skip is part of the layer
        try:
            self._network = IntegerMlp(weights)
        except ValueError as error:
            raise BitstreamError(f"a spatial model cannot be used: {error}") from error

    @property
    def flat(self) -> Tensor:
        """Integers of all weights and biases, layer by layer, float64 [1058]: what the compiled kernel takes."""
        return self._network.flat()

    def __call__(self, neighbors: Tensor) -> tuple[np.ndarray, np.ndarray]:
        """(mean int64 [n] with 12 fractional bits, level 0..63 of the scale) for neighbours int64 [n, 12]."""
        mean, s = self._network(neighbors << FRACTION).numpy().T
        return mean, np.clip((_OFFSET - _SLOPE * s) >> 28, 0, LEVELS - 1)
