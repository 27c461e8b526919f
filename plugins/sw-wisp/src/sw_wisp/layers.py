"""Layers of a progressive file: which subset a splat belongs to, what a prefix knows of it, which packet comes next."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from sw_wisp.decoded import SWELL_UNIT
from sw_wisp.numbers import LATENTS, NUMBERS, OPACITY, SIZE
from sw_wisp.packets import REFINED, default_order
from sw_wisp.pyramid import prefix_slots
from sw_wisp.rate import Forecast

Order = tuple[tuple[int, str], ...]
"""(subset, kind) of each packet."""
AT_ONCE = 0.06
"""Of the splats that are left, those that go before costs are measured anew."""
LEAST_WORTH = 0.01
"""Quantile of the positive costs of removal that those below it count as."""


@dataclass(frozen=True)
class Layers:
    """Packets of a file.

    order       of them; empty: one subset, `base` and `view`
    planes      refinements of shape, size and colour that come after `base`
    psnr        of the training views with the first 1, 2, ... packets, dB; empty: not measured
    swell       for 1, 2, ... of the subsets, while others are missing: of each of them what is added to size and
                opacity, in 1/32; empty: nothing
    """

    order: Order = ()
    planes: int = 0
    psnr: tuple[float, ...] = ()
    swell: tuple[tuple[int, ...], ...] = ()

    @classmethod
    def of_subsets(cls, subsets: int, planes: int) -> Layers:
        """Layers of so many subsets, packets in the order of `default_order`."""
        return cls(default_order(subsets, planes), planes)

    @property
    def subsets(self) -> int:
        """Number of subsets."""
        return max((subset for subset, _ in self.order), default=0) + 1

    def swell_with(self, there: int, device: torch.device) -> Tensor:
        """Return what is added [J,2] to size and opacity of each subset while so many are there."""
        found = torch.zeros(self.subsets, 2, device=device)
        if 0 < there <= len(self.swell):
            found[:there] = torch.tensor(self.swell[there - 1], device=device).view(there, 2) / SWELL_UNIT
        return found


class Known(NamedTuple):
    """Facts of each subset [J] that packets tell: it is there, missing refinements, latents; what swells it [J,2].

    slot    [J] which of the features that latents are predicted from, see `pyramid.prefix_slots`
    """

    there: Tensor
    missing: Tensor
    viewed: Tensor
    swell: Tensor
    slot: Tensor

    @classmethod
    def after(cls, packets: Sequence[tuple[int, str]], layers: Layers, device: torch.device) -> Known:
        """Return what some packets tell."""
        there, viewed = ([False] * layers.subsets for _ in range(2))
        missing = [layers.planes] * layers.subsets
        for subset, kind in packets:
            there[subset] |= kind == "base"
            viewed[subset] |= kind == "view"
            missing[subset] -= kind == "fine"
        slots = prefix_slots(packets)[-1]
        slots += [0] * (layers.subsets - len(slots))
        facts = [torch.tensor(each, device=device) for each in (there, missing, viewed, slots)]
        return cls(*facts[:3], layers.swell_with(sum(there), device), facts[3])

    def of(self, subsets: Tensor) -> Known:
        """Return the same for splats of these subsets [N]."""
        return Known(*(each[subsets] for each in self))


def as_known(values: Tensor, forecast: Forecast, known: Known) -> Tensor:
    """Return what a decoder has of values [N,22] where it lacks refinements and latents; gradients pass straight.

    known   of each splat
    """
    values = swelled(coarsened(values, forecast, known), known.swell)
    latents = torch.where(known.viewed[:, None], values[:, LATENTS.columns], forecast.mean[:, LATENTS.columns])
    return torch.cat([values[:, : LATENTS.columns.start], latents], dim=1)


def coarsened(values: Tensor, forecast: Forecast, known: Known) -> Tensor:
    """Return values [N,22] without the refinements that are missing; gradients pass straight."""
    width = torch.ones_like(values)
    width[:, REFINED] = 3.0 ** known.missing[:, None]
    offsets = ((values - forecast.mean) / forecast.steps).detach()
    coarse = torch.where(width > 1, (torch.round(offsets / width) * width - offsets) * forecast.steps.detach(), 0.0)
    return values + coarse


def swelled(values: Tensor, swell: Tensor) -> Tensor:
    """Return values [N,22] with something added [N,2] to size and opacity."""
    none = values.new_zeros(len(values), NUMBERS)
    size, opacity = SIZE.columns.start, OPACITY.columns.start
    parts = [none[:, :opacity], swell[:, 1:], none[:, opacity + 1 : size], swell[:, :1], none[:, size + 1 :]]
    return values + torch.cat(parts, dim=1)


def split(costs: Callable[[Tensor], Tensor], bits: Tensor, base: Tensor, shares: Sequence[float]) -> Tensor:
    """Return the subset [N] int64 of each splat: those go last that cost least for their bits.

    costs   (there [N] bool) -> [N], what pictures of those that are there lose without each of them
    bits    [N] of a splat's numbers and place
    base    [N] bits of its first packet, of which each subset gets its share

    Costs are measured anew whenever AT_ONCE of the splats have gone: of two that cover each other one stays.
    """
    sizes, there = base.double(), torch.ones_like(bits, dtype=torch.bool)
    ends = torch.tensor(shares, dtype=torch.float64, device=bits.device).cumsum(0)
    ends = ends * (sizes.sum() / ends[-1])
    penalty = bits.double().log()
    gone: list[Tensor] = []
    worth = costs(there).double()
    positive = worth[worth > 0]
    floor = float(torch.quantile(positive[: 1 << 24], LEAST_WORTH)) if len(positive) else 1.0
    while True:
        rows = there.nonzero().squeeze(1)
        priority = worth[rows].clamp_min(floor).log() - penalty[rows]
        order = rows[torch.argsort(priority, descending=True, stable=True)]
        enough = int((sizes[order].cumsum(0) < ends[0]).sum()) + 1
        kept = max(enough, int((1 - AT_ONCE) * len(order)))
        gone.insert(0, order[kept:])
        there[order[kept:]] = False
        if kept == enough:
            break
        worth = costs(there).double()
    order = torch.cat([order[:kept], *gone])
    found = torch.empty_like(order)
    found[order] = torch.searchsorted(ends[:-1], sizes[order].cumsum(0) - sizes[order] / 2)
    return found


def admissible(taken: Sequence[tuple[int, str]], layers: Layers) -> list[tuple[int, str]]:
    """Return the packets that may follow some: the base of the next subset, refinements and latents of those there."""
    there = sum(kind == "base" for _, kind in taken)
    found = [(there, "base")] if there < layers.subsets else []
    for subset in range(there):
        if taken.count((subset, "fine")) < layers.planes:
            found.append((subset, "fine"))
        if (subset, "view") not in taken:
            found.append((subset, "view"))
    return found


def greedy_order(
    layers: Layers, error: Callable[[Sequence[tuple[int, str]]], float], size: Callable[[tuple[int, str]], float]
) -> Order:
    """Return the order in which each packet lowers the error by most for its bits.

    error   of the pictures with some packets
    size    bits of a packet
    """
    taken: list[tuple[int, str]] = []
    before = 0.0
    while choices := admissible(taken, layers):
        errors = [error([*taken, choice]) if len(choices) > 1 or not taken else 0.0 for choice in choices]
        gains = [(before - after) / max(size(choice), 1.0) for choice, after in zip(choices, errors, strict=True)]
        best = max(range(len(choices)), key=gains.__getitem__)
        taken.append(choices[best])
        before = errors[best]
    return tuple(taken)
