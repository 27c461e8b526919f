"""Distributions of attributes for the file of HAC++: from grid and network, and slice by slice from known features.

Two of them, with the same face: `ExactPredictor` in integers, the same on every machine; `FloatPredictor` as trained,
for comparison with published sizes.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.float_mode import Mode, one_thread
from sw_anchors.lattice import TOP
from sw_anchors.row_parts import EXACT_NUMBERS, FLOAT_NUMBERS, by_parts
from sw_anchors.shape import GROUPS, AnchorShape
from torch import Tensor, nn

from sw_codecs.entropy.rows import RowContext, RowMixture
from sw_hac.mixed_grid import MixedHashGrid
from sw_hac.model import context_of
from sw_hac.predictors import BlockPrediction, row_width, short_features
from sw_hac_plus.channel_mixture import PARTS, ChannelMixture, ExactChannelMixture


@dataclass(frozen=True)
class FirstPrediction:
    """Prediction of the grid for a block of n anchors.

    groups      distributions and steps by group
    logit       [n,F] of the weight of the grid's Gaussian
    context     [n,3F] inputs of the channel networks
    """

    groups: BlockPrediction
    logit: Tensor
    context: Tensor


class ExactPredictor:
    """Integers with 12 fractional bits: means, scales and known features in base steps."""

    def __init__(
        self,
        grid: MixedHashGrid,
        network: nn.Sequential,
        channel: ChannelMixture,
        shape: AnchorShape,
        base_steps: tuple[float, float, float],
    ) -> None:
        """Raises ValueError if a network cannot be evaluated exactly."""
        self._grid, self._shape = grid, shape
        self._network = ExactNetwork(network, shape, base_steps, further=shape.features)
        self._channel, self._width = channel.exact(), channel.width

    def first(self, codes: Tensor) -> FirstPrediction:
        """Predict for anchors at `codes` [n,3] of the hash grid."""
        outputs = self._network.outputs(codes, short_features(self._grid), row_width(self._grid))
        count = sum(self._shape.outputs)
        found, logit = self._network.read(outputs[:, :count]), outputs[:, count:]
        features = found["features"]
        context = torch.cat([torch.as_tensor(features.mean), torch.as_tensor(features.scale), logit], dim=1)
        groups = {group: (each, self._network.steps(group, each)) for group, each in found.items()}
        return FirstPrediction(groups, logit, context)

    def mixture(self, index: int, columns: slice, first: FirstPrediction, known: Tensor) -> RowMixture:
        """Mixtures of slice `index`, once the features before it are `known`."""
        mean, scale, logit = _second(self._channel, index, known, first.context, self._width(index), EXACT_NUMBERS)
        grid, _ = first.groups["features"]
        return RowMixture(
            grid.mean[:, columns], grid.scale[:, columns], mean, scale, first.logit[:, columns] - logit, grid.step
        )

    def known(self, symbols: Tensor, first: FirstPrediction) -> Tensor:
        """Decoded features as the networks take them."""
        return symbols * torch.as_tensor(first.groups["features"][0].step)


class FloatPredictor:
    """Floats of the networks as trained, in units of the values; known features in base steps."""

    def __init__(
        self,
        grid: MixedHashGrid,
        network: nn.Sequential,
        channel: ChannelMixture,
        shape: AnchorShape,
        base_steps: tuple[float, float, float],
    ) -> None:
        self._grid, self._network, self._channel = grid, network, channel
        self._shape, self._base_steps = shape, base_steps

    def first(self, codes: Tensor) -> FirstPrediction:
        """Predict for anchors at `codes` [n,3] of the hash grid."""
        width = max(row_width(self._grid), self._network[0].out_features)
        with one_thread():
            outputs = by_parts(
                lambda part: self._network(self._grid(part.to(torch.float32) / TOP)), codes, width, FLOAT_NUMBERS
            )
        count, base = sum(self._shape.outputs), self._base_steps[0]
        found, logit = context_of(outputs[:, :count], self._shape, self._base_steps), outputs[:, count:]
        context = torch.cat([found.means[0] / base, found.scales[0] / base, logit], dim=1)
        groups = {
            group: (RowContext(mean.clamp(-1e6, 1e6), scale.clamp(1e-9, 1e6), step.double()), step.double())
            for group, mean, scale, step in zip(GROUPS, found.means, found.scales, found.steps, strict=True)
        }
        return FirstPrediction(groups, logit, context)

    def mixture(self, index: int, columns: slice, first: FirstPrediction, known: Tensor) -> RowMixture:
        """Mixtures of slice `index`, once the features before it are `known`."""
        with one_thread():
            width = self._channel.width(index)
            mean, scale, logit = _second(self._channel, index, known, first.context, width, FLOAT_NUMBERS)
        (grid, _), base = first.groups["features"], self._base_steps[0]
        return RowMixture(
            grid.mean[:, columns], grid.scale[:, columns], (base * mean).clamp(-1e6, 1e6),
            (base * scale).clamp(1e-9, 1e6), first.logit[:, columns] - logit, grid.step,
        )  # fmt: skip

    def known(self, symbols: Tensor, first: FirstPrediction) -> Tensor:
        """Decoded features as the networks take them."""
        return (symbols * first.groups["features"][1] / self._base_steps[0]).to(torch.float32)


def _second(
    channel: ChannelMixture | ExactChannelMixture, index: int, known: Tensor, context: Tensor, width: int, numbers: int
) -> tuple[Tensor, ...]:
    """Means, scales and logits of slice `index`; of as many rows at once as `width` leaves room for in `numbers`."""

    def part(rows: Tensor) -> Tensor:
        at = slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0)
        return channel.slice(index, known[at], context[at])

    outputs = by_parts(part, torch.arange(len(known)), width, numbers)
    return outputs.chunk(PARTS, dim=1)


Predictor = ExactPredictor | FloatPredictor
PREDICTORS: dict[Mode, type[ExactPredictor] | type[FloatPredictor]] = {"exact": ExactPredictor, "float": FloatPredictor}
