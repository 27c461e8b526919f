"""Estimate of a file's size by the rate model that training minimises, to hold the file against."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_anchors.rate_model import triple

from sw_codecs.entropy.rates import gaussian_bits
from sw_codecs.quantizers.rounding import SteRound

if TYPE_CHECKING:
    from sw_cat_3dgs.model import CatAnchors

SECTIONS = ("features", "scalings", "offsets")


@torch.no_grad()
def estimated_bits(model: CatAnchors) -> dict[str, float]:
    """Estimate the bits of the sections features (all slices), scalings, offsets, triplane and masks.

    Of all kept anchors, rounded, in floats, with the likelihood of training but for its floors; headers are not
    counted. Needs a triplane.
    """
    context, rounding = model.context, SteRound()
    rounded, context.rounded = context.rounded, True
    rows = torch.nonzero(model.kept()).squeeze(1)
    first = model.predict(rows)
    values = triple(
        rounding.forward(v, step, mean=centre)
        for v, step, centre in zip(model.raw(rows), first.steps, model.centres(), strict=True)
    )
    found = context.refine(first, values[0])
    masks = model.masks(rows)
    bits = {}
    for name, value, mean, scale, step in zip(SECTIONS, values, found.means, found.scales, found.steps, strict=True):
        each = gaussian_bits(value, mean, scale.clamp(min=1e-9), step)
        bits[name] = float((each * masks.repeat_interleave(3, dim=1) if name == "offsets" else each).sum())
    planes = [torch.round(16 * plane) for plane in context.triplane.planes]
    bits["triplane"] = float(
        sum(a.bits(p).sum() for plane in planes for a, p in zip(context.spatial_models, plane, strict=True))
    )
    share = masks.mean().clamp(1e-6, 1 - 1e-6)
    bits["masks"] = float(-(masks * share.log2() + (1 - masks) * (1 - share).log2()).sum())
    context.rounded = rounded
    return bits
