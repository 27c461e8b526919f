"""Bits of HAC++ straight from what networks predict, with their derivatives: one node, one kernel."""

from __future__ import annotations

from typing import Protocol
from weakref import WeakKeyDictionary

import torch
from sw_anchors.rate_model import AnchorForecast
from torch import Tensor

from sw_hac.fast import predicted_bits
from sw_hac.fast.predicted_bits import MaskKind, mixture_bits, reading
from sw_hac_plus.channel_mixture import ChannelMixture
from sw_hac_plus.fast.channel_networks import ChannelNetworks


class Model(predicted_bits.Model, Protocol):
    """Members of a rate model that are read here."""

    @property
    def channel(self) -> ChannelMixture | None:
        """Second Gaussian of each feature."""
        ...

    @property
    def anchor_gradient(self) -> bool:
        """Whether the gradient of all bits of an anchor reaches its masks."""
        ...


def fits(model: Model, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor) -> bool:
    """Whether there are kernels for such tensors, all float32 of one device; loads them."""
    own = model.channel is None or all(p.dtype == torch.float32 for p in model.channel.parameters())
    return own and predicted_bits.fits(values, forecast, masks, counted)


def rate(
    model: Model, values: Tensor, forecast: AnchorForecast, masks: Tensor, counted: Tensor
) -> tuple[Tensor, Tensor]:
    """As `HACPlusRateModel.bits`."""
    read = reading(model, forecast.outputs, MaskKind.GATED_MEAN if model.anchor_gradient else MaskKind.GATED)
    given = (values, forecast.outputs, forecast.sample_steps, masks, counted, read)
    if model.channel is None:
        return mixture_bits(*given)
    parameters = tuple(ChannelNetworks.parameters(model.channel))
    return mixture_bits(*given, _layout(model.channel, values.device), parameters)


def _layout(channel: ChannelMixture, device: torch.device) -> ChannelNetworks:
    """Layout of the networks; none replaces another: graphs read their tensors where they stand."""
    layouts = _LAYOUTS.setdefault(channel, {})
    if device not in layouts:
        layouts[device] = ChannelNetworks(channel, device)
    return layouts[device]


_LAYOUTS: WeakKeyDictionary[ChannelMixture, dict[torch.device, ChannelNetworks]] = WeakKeyDictionary()
