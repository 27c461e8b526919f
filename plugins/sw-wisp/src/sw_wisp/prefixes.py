"""Prefixes of a model's file, drawn: which packet is worth its bytes next, and what each prefix shows in the end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.api import ContainerReader, ContainerWriter, RasterOptions, photometric_loss
from sw_wisp.decoded import SWELL_UNIT
from sw_wisp.file import MOST_SWELL, decode, encode
from sw_wisp.layers import Known, Order, as_known, greedy_order
from sw_wisp.nested import THIRD_OF_SCALE, UNIT
from sw_wisp.numbers import LATENTS, NUMBERS, OPACITY
from sw_wisp.packets import REFINED
from sw_wisp.plain import gaussians_of
from sw_wisp.rate import Forecast
from sw_wisp.rate_model import bits_of

if TYPE_CHECKING:
    from splatwizard_core.api import GaussianInputs, Rasterizer, SplatModel, View
    from sw_wisp.model import WispModel


SWELL_LR = 0.05
"""Adam step size of the first update; it falls to 0."""


@torch.no_grad()
def packet_bits(values: Tensor, forecast: Forecast, places: Tensor, planes: int) -> dict[str, Tensor]:
    """Return the bits [N] that each kind of packet spends on splats; those of all refinements together.

    values      [N,22] as rounded
    places      [N] bits of their places
    """
    there, missing, slot = (places.new_full((len(places),), x, dtype=torch.int64) for x in (1, planes, 0))
    known = Known(there, missing, places >= 0, values.new_zeros(len(values), 2), slot)
    widths = values.new_ones(NUMBERS)
    widths[REFINED] = 3.0**planes
    scale = forecast.scale - (widths > 1) * (planes * THIRD_OF_SCALE / UNIT)
    coarse = bits_of(as_known(values, forecast, known), Forecast(forecast.mean, scale, forecast.steps * widths))
    whole = bits_of(values, forecast)
    base = coarse[:, REFINED].sum(1) + whole[:, OPACITY.columns].sum(1) + places
    fine = (whole[:, REFINED].sum(1) - coarse[:, REFINED].sum(1)).clamp_min(0)
    return {"base": base, "fine": fine, "view": whole[:, LATENTS.columns].sum(1)}


@torch.no_grad()
def chosen_order(model: WispModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor) -> Order:
    """Return the packets in the order in which each lowers the error of `views` by most for its estimated bits."""
    forecast, drawn = model.predicted()
    bits = packet_bits(drawn, forecast, model.place_bits().float(), model.layers.planes)
    sums = {
        kind: drawn.new_zeros(model.layers.subsets, dtype=torch.float64).index_add_(0, model.subsets, each.double())
        for kind, each in bits.items()
    }
    sums["fine"] /= max(model.layers.planes, 1)

    def error(packets: Sequence[tuple[int, str]]) -> float:
        seen = model.prefix_of(packets, model.forecast_with(packets, forecast, drawn), drawn)
        return squared_error(seen, views, rasterizer, background)

    return greedy_order(model.layers, error, lambda packet: float(sums[packet[1]][packet[0]]))


@torch.no_grad()
def squared_error(
    gaussians: GaussianInputs, views: Sequence[View], rasterizer: Rasterizer, background: Tensor
) -> float:
    """Return the squared error of renders of `views`, summed over pixels and colours."""
    options, total = RasterOptions(background=background), 0.0
    for view in views:
        image = rasterizer.render(gaussians, view.camera.to(background.device), options).image
        total += float((image - view.image(background, background.device)).double().square().sum())
    return total


@torch.enable_grad()
def fitted_swell(
    model: WispModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor, updates: int,
    draws: torch.Generator,
) -> tuple[tuple[int, ...], ...]:  # fmt: skip
    """Return for 1, 2, ... subsets, while others are missing, what is added to size and opacity of each, in 1/32.

    Few splats then cover what those that are missing leave open. Found from what the model has by so many updates for
    each number of subsets, all else fixed, in turn over the prefixes that have so many.
    """
    with torch.no_grad():
        forecast, drawn = model.predicted()
    order, options, found = model.layers.order, RasterOptions(background=background), []
    for there in range(1, model.layers.subsets):
        ends = [n for n in range(1, len(order)) if sum(kind == "base" for _, kind in order[:n]) == there]
        forecasts = [model.forecast_with(order[:end], forecast, drawn) for end in ends]
        swell = model.layers.swell_with(there, model.device).requires_grad_()
        optimizer = torch.optim.Adam([swell], lr=SWELL_LR)
        for update in range(updates):
            view = views[int(torch.randint(len(views), (), generator=draws))]
            optimizer.param_groups[0]["lr"] = SWELL_LR * (1 - update / updates)
            gaussians = model.prefix_of(order[: ends[update % len(ends)]], forecasts[update % len(ends)], drawn, swell)
            image = rasterizer.render(gaussians, view.camera.to(model.device), options).image
            loss = photometric_loss(image, view.image(background, model.device)).total
            (swell.grad,) = torch.autograd.grad(loss, [swell])
            optimizer.step()
        whole = (swell.detach() * SWELL_UNIT).round().clamp(-MOST_SWELL, MOST_SWELL).int()
        found.append(tuple(whole[:there].flatten().tolist()))
    return tuple(found)


@torch.no_grad()
def psnr_of_prefixes(
    model: WispModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor
) -> tuple[float, ...]:
    """Return the mean PSNR of `views`, dB, with the first 1, 2, ... packets of the file, as decoders draw them."""
    writer = ContainerWriter("wisp", 1)
    encode(replace(model.coded(), psnr=None), writer)
    data, found, last = writer.to_bytes(), [], 0.0
    whole = ContainerReader(data)
    ends = {cut.sections: whole.header_bytes + cut.bytes for cut in whole.cuts}
    for number in range(len(model.layers.order)):
        if number + 2 in ends:  # else there is nothing in the packet
            part = decode(ContainerReader(data[: ends[number + 2]]))
            last = _psnr(gaussians_of(part).to(background.device), views, rasterizer, background)
        found.append(last)
    return tuple(found)


def _psnr(model: SplatModel, views: Sequence[View], rasterizer: Rasterizer, background: Tensor) -> float:
    options, total = RasterOptions(background=background), 0.0
    for view in views:
        camera = view.camera.to(background.device)
        image = rasterizer.render(model.gaussians(camera, rasterizer), camera, options).image.clamp(0, 1)
        error = (image - view.image(background, background.device)).double().square().mean()
        total += -10 * math.log10(max(float(error), 1e-10))
    return total / len(views)
