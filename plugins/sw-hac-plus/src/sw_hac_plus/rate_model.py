"""The rate model of HAC++: that of HAC, with a second Gaussian of each feature from the channels before it.

The network behind the grid has F further outputs: logits of the weight of its Gaussian. `bits_of_numbers` has the
mixture, `shares` how masks take part in the rate; `rate` takes the form of `fast` where there are kernels, so a change
of these two is seen with SW_FAST=0. Source: HAC++ (arXiv 2501.12255), and published facts about the authors' code.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from sw_anchors.attribute_sections import ExactNetwork
from sw_anchors.float_mode import one_thread
from sw_anchors.rate_model import AnchorForecast, floored
from sw_anchors.row_parts import MAX_EXACT_NUMBERS, MAX_FLOAT_NUMBERS, by_parts
from torch import Tensor

from sw_codecs.entropy import further_rates, rates
from sw_codecs.entropy.rows import RowMixture
from sw_hac.rate_model import BlockPrediction, HACRateModel, float_outputs, float_prediction
from sw_hac.rate_model import Predictor as GridPredictor
from sw_hac_plus.channel_mixture import PARTS, ChannelMixture, ExactChannelMixture
from sw_hac_plus.fast import mixture_bits


@dataclass(frozen=True)
class HACPlusRateModel(HACRateModel):
    """A HACRateModel with a channel context, whose rate may switch an anchor off.

    channel             second Gaussian of each feature; None: the grid alone predicts, as in HAC
    anchor_gradient     whether the gradient of all bits of an anchor reaches its masks
    """

    channel: ChannelMixture | None = None
    anchor_gradient: bool = True

    def rate(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of noisy values [S,C], by kernels where there are some; see `bits`."""
        fits = mixture_bits.fits(self, values, forecast, masks, counted)
        count = mixture_bits.rate if fits else HACPlusRateModel.bits
        return count(self, values, forecast, masks, counted)

    def bits(self, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Count the bits of noisy values [S,C], of features under two Gaussians; those of a masked number are 0.

        Arguments and result as of `HACRateModel.bits`.
        """
        bits = self.bits_of_numbers(values, forecast) * (self.shares(masks) * counted[:, None])
        return bits.sum(), self.shape.sums(bits.detach())

    def shares(self, masks: Tensor) -> Tensor:
        """Return factors [S,C] of the bits: 1 where an anchor has a Gaussian, else 0; of an offset times its mask.

        With `anchor_gradient` the gradient of the first is that of the mean mask.
        """
        mean = masks.mean(dim=1, keepdim=True)
        there = (mean > 0).to(mean)
        if self.anchor_gradient:
            there = mean + (there - mean).detach()  # 1 or 0, with the gradient of the mean
        return self.shape.joined(there, there, there * masks)

    def bits_of_numbers(self, values: Tensor, forecast: AnchorForecast) -> Tensor:
        """Return bits [S,C] of noisy values under the grid's Gaussians, of features under the mixture of both."""
        found, f, smallest = self.read(forecast.outputs), self.shape.features, self.floors.probability
        mean, steps = torch.cat(found.means, dim=1), self.shape.widened(forecast.sample_steps)
        scale = floored(torch.cat(found.scales, dim=1), steps, values - mean, self.floors)
        if self.channel is None:
            return rates.gaussian_bits(values, mean, scale, steps, p_min=smallest)
        base = self.base_steps[0]
        logit = forecast.outputs[:, sum(self.shape.outputs) :]
        inputs = torch.cat([found.means[0] / base, found.scales[0] / base, logit], dim=1)
        second_mean, second_scale, second_logit = self.channel(values[:, :f] / base, inputs)
        second_mean = base * second_mean
        second_scale = floored(base * second_scale, steps[:, :f], values[:, :f] - second_mean, self.floors)
        features = further_rates.mixture_bits(
            values[:, :f],
            torch.stack([logit, second_logit], dim=-1),
            torch.stack([mean[:, :f], second_mean], dim=-1),
            torch.stack([scale[:, :f], second_scale], dim=-1),
            steps[:, :f],
            p_min=smallest,
        )
        others = rates.gaussian_bits(values[:, f:], mean[:, f:], scale[:, f:], steps[:, f:], p_min=smallest)
        return torch.cat([features, others], dim=1)

    def exact(self) -> GridPredictor | ExactMixtures:  # type: ignore[override]
        """Return the rate model in integers: of mixtures, where there is a channel context."""
        return HACRateModel.exact(self) if self.channel is None else ExactMixtures(self, self.channel)

    def floats(self) -> GridPredictor | FloatMixtures:  # type: ignore[override]
        """Return the rate model in floats."""
        return HACRateModel.floats(self) if self.channel is None else FloatMixtures(self, self.channel)


@dataclass(frozen=True)
class FirstPrediction:
    """Prediction of the grid for a block of n anchors: all that is known before the first feature is.

    groups          distributions and steps by group
    logit           [n,F] of the weight of the grid's Gaussian
    channel_inputs  [n,3F] inputs of the channel networks
    """

    groups: BlockPrediction
    logit: Tensor
    channel_inputs: Tensor


class ExactMixtures:
    """A HACPlusRateModel in integers with 12 fractional bits: means, scales and known features in base steps."""

    def __init__(self, model: HACPlusRateModel, channel: ChannelMixture) -> None:
        """Raises ValueError if a network cannot be evaluated exactly."""
        shape = model.shape
        self._model, self._network = model, ExactNetwork(model.network, shape, model.base_steps, further=shape.features)
        self._channel, self._width = channel.exact(), channel.width

    def first(self, codes: Tensor) -> FirstPrediction:
        """Predict for anchors at `codes` [n,3] of the hash grid."""
        outputs = self._network.outputs(codes, self._model.short_features, self._model.row_width)
        count = sum(self._model.shape.outputs)
        found, logit = self._network.read(outputs[:, :count]), outputs[:, count:]
        features = found["features"]
        inputs = torch.cat([torch.as_tensor(features.mean), torch.as_tensor(features.scale), logit], dim=1)
        groups = {group: (each, self._network.steps(group, each)) for group, each in found.items()}
        return FirstPrediction(groups, logit, inputs)

    def mixture(self, index: int, columns: slice, first: FirstPrediction, known: Tensor) -> RowMixture:
        """Return the mixtures of slice `index`, its `columns`, once the features [n,i] before it are `known`."""
        mean, scale, logit = _second(
            self._channel, index, known, first.channel_inputs, self._width(index), MAX_EXACT_NUMBERS
        )
        grid, _ = first.groups["features"]
        return RowMixture(
            grid.mean[:, columns], grid.scale[:, columns], mean, scale, first.logit[:, columns] - logit, grid.step
        )

    def known(self, symbols: Tensor, first: FirstPrediction) -> Tensor:
        """Return integers [n,n_i] of features as the networks of later slices take them: in base steps."""
        return symbols * torch.as_tensor(first.groups["features"][0].step)


class FloatMixtures:
    """A HACPlusRateModel in floats: means and scales in units of the values, known features in base steps."""

    def __init__(self, model: HACPlusRateModel, channel: ChannelMixture) -> None:
        self._model, self._channel = model, channel

    def first(self, codes: Tensor) -> FirstPrediction:
        """Predict for anchors at `codes` [n,3] of the hash grid."""
        outputs = float_outputs(self._model, codes)
        found, base = self._model.read(outputs), self._model.base_steps[0]
        logit = outputs[:, sum(self._model.shape.outputs) :]
        inputs = torch.cat([found.means[0] / base, found.scales[0] / base, logit], dim=1)
        groups = float_prediction(found)
        return FirstPrediction(groups, logit, inputs)

    def mixture(self, index: int, columns: slice, first: FirstPrediction, known: Tensor) -> RowMixture:
        """Return the mixtures of slice `index`, its `columns`, once the features [n,i] before it are `known`."""
        with one_thread():
            width = self._channel.width(index)
            mean, scale, logit = _second(self._channel, index, known, first.channel_inputs, width, MAX_FLOAT_NUMBERS)
        (grid, _), base = first.groups["features"], self._model.base_steps[0]
        return RowMixture(
            grid.mean[:, columns], grid.scale[:, columns], (base * mean).clamp(-1e6, 1e6),
            (base * scale).clamp(1e-9, 1e6), first.logit[:, columns] - logit, grid.step,
        )  # fmt: skip

    def known(self, symbols: Tensor, first: FirstPrediction) -> Tensor:
        """Return integers [n,n_i] of features as the networks of later slices take them: in base steps."""
        return (symbols * first.groups["features"][1] / self._model.base_steps[0]).to(torch.float32)


Predictor = GridPredictor | ExactMixtures | FloatMixtures


def _second(
    channel: ChannelMixture | ExactChannelMixture, index: int, known: Tensor, inputs: Tensor, width: int, numbers: int
) -> tuple[Tensor, ...]:
    """Means, scales and logits of slice `index`; of as many rows at once as `width` leaves room for in `numbers`."""

    def part(rows: Tensor) -> Tensor:
        at = slice(int(rows[0]), int(rows[-1]) + 1) if len(rows) else slice(0)
        return channel.slice(index, known[at], inputs[at])

    outputs = by_parts(part, torch.arange(len(known)), width, numbers)
    return outputs.chunk(PARTS, dim=1)
