"""How large a file will be, by the rate model that training minimises: what the file is held against."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_anchors.coded_anchors import rounded_indices

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from sw_cat_3dgs.model import CatAnchors

SECTIONS = ("features", "scalings", "offsets")


@torch.no_grad()
def estimated_bits(model: CatAnchors, plugins: PluginManager) -> dict[str, float]:
    """Bits of the sections features (all slices), scalings, offsets, triplane and masks, of all kept anchors, rounded.

    In floats, with the likelihood of training but for its floors; headers are not counted. Needs a triplane.
    """
    context, entropy = model.context, plugins.entropy_models.load("gaussian-exact")()
    rounded, context.rounded = context.rounded, True
    rows = torch.nonzero(model.kept()).squeeze(1)
    first = model.predict(rows)
    values = tuple(
        rounded_indices(v, step, centre) * step
        for v, step, centre in zip(model.raw(rows), first.steps, model.centres(), strict=True)
    )
    found = context.refine(first, values[0])
    masks = model.masks(rows)
    bits = {}
    for name, value, mean, scale, step in zip(SECTIONS, values, found.means, found.scales, found.steps, strict=True):
        each = entropy.bits(value, entropy.FloatContext(mean, scale.clamp(min=1e-9), step))
        bits[name] = float((each * masks.repeat_interleave(3, dim=1) if name == "offsets" else each).sum())
    planes = [torch.round(16 * plane) for plane in context.triplane.planes]
    bits["triplane"] = float(sum(a.bits(p).sum() for plane in planes for a, p in zip(context.arms, plane, strict=True)))
    share = masks.mean().clamp(1e-6, 1 - 1e-6)
    bits["masks"] = float(-(masks * share.log2() + (1 - masks) * (1 - share).log2()).sum())
    context.rounded = rounded
    return bits
