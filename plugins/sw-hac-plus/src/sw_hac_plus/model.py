"""The model of HAC++: anchors on the lattice of voxels, whose features are predicted by the grid and by one another.

Source: HAC++ (arXiv 2501.12255), and published facts about the authors' code.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from sw_anchors.anchors import AnchorAttributes, linear_layers
from sw_anchors.coded_anchors import MASK_THRESHOLD
from sw_anchors.fast.fused_ops import anchor_values, noisy_rows, times_ones
from sw_anchors.fast.mixture_bits import MaskKind, fit_mixture_kernel, mixture_bits
from sw_anchors.fast.seen_rows import SeenRows
from sw_anchors.forecasts import AnchorForecast, AnchorRate
from sw_anchors.lattice import position_codes
from torch import Tensor, nn

from sw_codecs.entropy import rates
from sw_codecs.quantizers.rounding import add_noise
from sw_hac.model import SMALLEST_STEP, HACAnchors
from sw_hac_plus.channel_mixture import ChannelMixture
from sw_hac_plus.fast.channel_networks import ChannelNetworks
from sw_hac_plus.fast.steps_and_outputs import steps_and_outputs
from sw_hac_plus.voxel_lattice import voxel_integers, voxel_positions, within_reach

if TYPE_CHECKING:
    from sw_anchors.fast.pool_rows import PoolRows

    from splatwizard_core.api import Camera, GaussianInputs


@dataclass(frozen=True, kw_only=True)
class PoolForecast(AnchorForecast):
    """An AnchorForecast whose sample is drawn from all anchors of the model.

    rows            [S] int64, the sample; None: whoever asked has its rows
    sample_steps    [S,3] quantiser steps of it
    outputs         [S,W] of the network behind the grid, over `units`
    """

    rows: Tensor | None
    sample_steps: Tensor
    outputs: Tensor


class HACPlusAnchors(HACAnchors):
    """HACAnchors on a lattice of voxels, with a channel context; the rate of any anchor may switch it off.

    channel             second Gaussian of each feature; None: the grid alone predicts, as in HAC
    anchor_gradient     whether the gradient of all bits of an anchor reaches its masks

    The network behind the grid has F further outputs: logits of the weight of its Gaussian.
    """

    COUNTS_MASKED = True
    SAMPLES_ALL = True

    def __init__(
        self, *tensors: Tensor, channel: ChannelMixture | None, anchor_gradient: bool = True, **kwargs: Any
    ) -> None:
        """As HACAnchors."""
        super().__init__(*tensors, further=0 if channel is None else tensors[1].shape[1], **kwargs)
        self.channel = None if channel is None else channel.to(self.features)
        self.anchor_gradient = anchor_gradient
        self._layouts: dict[torch.device, ChannelNetworks] = {}

    def networks(self) -> dict[str, nn.Module]:
        return super().networks() | ({} if self.channel is None else {"channel": self.channel})

    def lattice_places(self) -> tuple[Tensor, Tensor]:
        positions = voxel_positions(voxel_integers(self.anchors, self.voxel_size), self.voxel_size)
        return position_codes(positions, self.bounds), positions

    def holds(self, positions: Tensor) -> Tensor:
        """[M] bool: `positions` [M,3] that the file can hold beside the anchors."""
        return within_reach(positions, self.anchors, self.voxel_size)

    # Rendering

    def attributes(self, rows: Tensor) -> AnchorAttributes:
        found = super().attributes(rows)
        return dataclasses.replace(found, extras={**found.extras, "masks": found.masks}) if self.training else found

    def decode_seen(self, camera: Camera, rows: SeenRows) -> GaussianInputs:
        """The Gaussians of the anchors `rows`; masks have a gradient through opacities and scales alike."""
        found = super().decode_seen(camera, rows)
        if "masks" not in found.extras:
            return found
        # Of those drawn all masks are 1; what is masked would be drawn with scale 0, and is left out.
        assert found.scales is not None
        drawn = found.extras["anchors"].drawn
        return dataclasses.replace(found, scales=times_ones(found.scales, found.extras["masks"], drawn))

    # Rate

    def forecast(self, rows: Tensor) -> PoolForecast:
        """Predict steps of the anchors `rows`, and for a sample of all anchors what their bits are counted with."""
        drawn, parts = self.draw_sample(self.num_rows), self.context_rows()
        found = self.forecast_pool(*(tuple(part.index_select(0, each) for part in parts) for each in (rows, drawn)))
        return dataclasses.replace(found, rows=drawn)

    def forecast_pool(self, parts: tuple[Tensor, ...], pool: tuple[Tensor, ...]) -> PoolForecast:
        both = tuple(torch.cat(pair) for pair in zip(parts, pool, strict=True))
        features, bits = self._looked_up(both)
        first, last = linear_layers(self.mlp_grid)
        parameters = (first.weight, first.bias, last.weight, last.bias)
        visible, count = len(parts[0]), self._distributions
        steps, outputs = steps_and_outputs(
            features, parameters, self.base_steps_like(features),
            part=slice(count, count + 3), start=visible, offset=1.0, smallest=SMALLEST_STEP,
        )  # fmt: skip
        seen, sampled = torch.split(steps, [visible, len(pool[0])])
        return PoolForecast(seen, bits, None, self._no_sample, rows=None, sample_steps=sampled, outputs=outputs)

    @property
    def _distributions(self) -> int:
        """Outputs of the network before the step logits."""
        return sum(self.shape.outputs[:-1])

    @staticmethod
    def _no_sample(drawn: Tensor, hidden: Tensor | None, values: Tensor) -> tuple[Tensor, Tensor]:
        raise NotImplementedError("the bits of HAC++ are no Gaussian's alone: HACPlusAnchors.rate counts them")

    def sampled(self, count: int) -> Tensor:
        """None of the visible anchors: the rate looks at a sample of all."""
        return torch.zeros(0, dtype=torch.int64, device=self.device)

    def rate(self, drawn: Tensor, sample: Tensor, forecast: AnchorForecast, masks: Tensor) -> AnchorRate:
        """Estimate the bits a number over a sample of all anchors, under noise of its own.

        Masked anchors and offsets have no bits, but count as numbers. What is drawn in this view is no matter.
        """
        assert isinstance(forecast, PoolForecast)
        assert forecast.rows is not None
        if not len(forecast.rows):
            nothing = self.mask_logits.new_zeros(())
            return AnchorRate(nothing, nothing.new_zeros(3), nothing, forecast.own_bits)
        values, masks = anchor_values(
            forecast.rows, self.features, self.log_scales, self.offsets, self.mask_logits, None, MASK_THRESHOLD
        )
        values = add_noise(values, self.widened(forecast.sample_steps), self.uniform(*values.shape))
        return self._rate_of(values, masks, values.new_ones(len(values)), forecast)

    def pool_rate(self, pool: PoolRows, forecast: AnchorForecast) -> AnchorRate:
        assert isinstance(forecast, PoolForecast)
        values, _, masks, _ = noisy_rows(
            pool.parameters, None, pool.size, pool.random, forecast.sample_steps, MASK_THRESHOLD
        )
        return self._rate_of(values, masks, pool.counted, forecast)

    def _rate_of(self, values: Tensor, masks: Tensor, counted: Tensor, forecast: PoolForecast) -> AnchorRate:
        """Estimate the bits of noisy values [S,C] of anchors; those that are not counted [S] are as if not there."""
        total, by_group = self._total_bits(values, masks, counted, forecast)
        numbers = counted.sum() * values.shape[1]
        return AnchorRate(total / numbers.clamp(min=1), by_group, numbers, forecast.own_bits)

    def _total_bits(
        self, values: Tensor, masks: Tensor, counted: Tensor, forecast: PoolForecast
    ) -> tuple[Tensor, Tensor]:
        """(bits of all that count, by group [3] without gradient); other arguments as of `_rate_of`."""
        parameters = () if self.channel is None else tuple(ChannelNetworks.parameters(self.channel))
        given = (values, forecast.outputs, forecast.sample_steps, masks, counted)
        if fit_mixture_kernel(*given, self.units, *parameters):
            kind = MaskKind.GATED_MEAN if self.anchor_gradient else MaskKind.GATED
            networks = self._networks_on(values.device)
            return mixture_bits(*given, self.read_as(self.units, kind), networks, parameters)
        bits = self._bits(values, self.widened(forecast.sample_steps), forecast.outputs)
        bits = bits * (self._shares(masks) * counted[:, None])
        return bits.sum(), bits.detach().sum(dim=0) @ self._columns(bits)[1]

    def _networks_on(self, device: torch.device) -> ChannelNetworks | None:
        """Layout of the networks of channels; none replaces another: graphs read their tensors where they stand."""
        if self.channel is not None and device not in self._layouts:
            self._layouts[device] = ChannelNetworks(self.channel, device)
        return self._layouts.get(device)

    def _shares(self, masks: Tensor) -> Tensor:
        """[S,C] factors of the bits: whether the anchor is there, for an offset times its mask; with gradient."""
        mean = masks.mean(dim=1)
        there = (mean > 0).to(mean)
        if self.anchor_gradient:
            there = mean + (there - mean).detach()  # 1 or 0, with the gradient of the mean
        widths = self.shape.widths
        offsets = (there[:, None] * masks)[:, :, None].expand(-1, -1, 3).flatten(1)
        return torch.cat([there[:, None].expand(-1, widths[0] + widths[1]), offsets], dim=1)

    def _bits(self, values: Tensor, steps: Tensor, outputs: Tensor) -> Tensor:
        """[S,C] bits of noisy values under the grid's Gaussians, of features under the mixture with the channels'."""
        outputs = outputs * self.units
        f, count = self.shape.features, self._distributions
        parts = torch.split(outputs[:, :count], self.shape.outputs[:-1], dim=1)
        mean = torch.cat(parts[0::2], dim=1)
        scale = self.floored(torch.cat(parts[1::2], dim=1), steps)
        if self.channel is None:
            return rates.gaussian_bits(values, mean, scale, steps, p_min=self.smallest_probability)
        base, logit = self.base_steps[0], outputs[:, count + 3 :]
        context = torch.cat([parts[0] / base, parts[1] / base, logit], dim=1)
        second_mean, second_scale, second_logit = self.channel(values[:, :f] / base, context)
        features = rates.mixture_bits(
            values[:, :f],
            torch.stack([logit, second_logit], dim=-1),
            torch.stack([mean[:, :f], base * second_mean], dim=-1),
            torch.stack([scale[:, :f], self.floored(base * second_scale, steps[:, :f])], dim=-1),
            steps[:, :f],
            p_min=self.smallest_probability,
        )
        others = rates.gaussian_bits(
            values[:, f:], mean[:, f:], scale[:, f:], steps[:, f:], p_min=self.smallest_probability
        )
        return torch.cat([features, others], dim=1)
