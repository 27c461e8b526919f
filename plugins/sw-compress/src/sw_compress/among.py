"""A part of a scene drawn among the rest of it, which is coarse: it hides, and is seen through."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from sw_gaussians.merging import Splats, merge_groups, model_of, splats_of
from torch import Tensor

from splatwizard_core.api import SH, AccumOutput, Camera, GaussianInputs, GaussianModel, RasterOptions, RenderResult

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer

MEMBERS = 16
"""Gaussians that one stands for."""
GROUPS_AT_ONCE = 1 << 12
"""Groups that merge together: in float64 each takes some kB on the way."""


class Among:
    """A rasterizer that draws others beside what it is given, and tells of what it is given alone.

    others  SH degree 0
    """

    def __init__(self, rasterizer: Rasterizer, others: GaussianModel) -> None:
        self._rasterizer, self._others, self.info = rasterizer, others, rasterizer.info

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        found = self._rasterizer.render(self._with_others(g, cam), cam, opt)
        return replace(found, radii=found.radii[: len(g)], inputs=g)

    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        return self._rasterizer.visible_filter(g, cam)

    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        cams = list(cams)
        found = self._rasterizer.accumulate(self._with_others(g, cams[0]), cams, opt)
        return AccumOutput({name: values[: len(g)] for name, values in found.scores.items()})

    def _with_others(self, g: GaussianInputs, cam: Camera) -> GaussianInputs:
        """Both, those given first."""
        others = self._others.gaussians(cam, self._rasterizer)
        ours, theirs = g.tensors(), others.tensors()
        both = {name: torch.cat([ours[name], theirs[name]]) for name in theirs}
        rest = ours.get("sh.rest")
        if rest is not None:
            rest = torch.cat([rest, rest.new_zeros(len(others), *rest.shape[1:])])
        sh = SH(dc=both.pop("sh.dc"), rest=rest, active_degree=0 if g.sh is None else g.sh.active_degree)
        return GaussianInputs(**both, sh=sh)


@torch.no_grad()
def coarse(model: GaussianModel, rows: Tensor) -> GaussianModel:
    """One Gaussian for each of some runs of 16 of these rows [M], in their order; of SH degree 0."""
    whole = len(rows) // MEMBERS * MEMBERS
    found = [splats_of(model, rows[whole:])]
    for part in rows[:whole].split(GROUPS_AT_ONCE * MEMBERS):
        groups = splats_of(model, part)
        grouped = Splats(*(values.view(-1, MEMBERS, *values.shape[1:]) for values in groups))
        found.append(merge_groups(grouped, rule="mass", widen=True).to(torch.float32))
    all_of = Splats(*(torch.cat(each) for each in zip(*found, strict=True)))
    return model_of(all_of, torch.arange(len(all_of.means), device=all_of.means.device), model)


def without(count: int, rows: Tensor) -> Tensor:
    """The rows [M] of 0 .. count - 1 that are not among some."""
    left = torch.ones(count, dtype=torch.bool, device=rows.device)
    left[rows] = False
    return left.nonzero().squeeze(1)


def sample_rows(count: int, wanted: int, run: int) -> Tensor:
    """About `wanted` rows of 0 .. count - 1 in runs of equal length, evenly spread; neighbours stay together."""
    if count <= wanted:
        return torch.arange(count)
    runs = max(1, round(wanted / run))
    starts = (torch.arange(runs, dtype=torch.float64) + 0.5) * count / runs - run / 2
    found = starts.long()[:, None].clamp(0, max(count - run, 0)) + torch.arange(min(run, count))
    return found.flatten().unique()
