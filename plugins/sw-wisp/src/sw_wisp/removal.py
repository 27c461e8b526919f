"""Removal of splats that cost more bits than they are worth, and copies of others in place of some."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_gaussians.density.mcmc import draw, shared_among
from torch import Tensor

from splatwizard_core.api import SplatOptimizer, stream

if TYPE_CHECKING:
    from sw_wisp.model import WispModel

MOST_OPAQUE = 6.0
"""Largest opacity logit that is kept."""


def unworthy(loss_rise: Tensor, bits: Tensor, price: float, share: float) -> Tensor:
    """Return the rows [K] int64 whose removal lowers the loss with its bits, at most a share of all, worst first.

    loss_rise   [N] how much the loss rises without each of them
    bits        [N] > 0, what each of them takes in the file
    price       loss of one bit
    """
    gain = loss_rise.double() - price * bits.double()
    count = min(int((gain < 0).sum()), int(share * len(bits)))
    worth = loss_rise.double() / bits.double()
    return torch.sort(worth, stable=True).indices[:count]


@torch.no_grad()
def copy_some(model: WispModel, optimizer: SplatOptimizer, count: int, step: int) -> int:
    """Add `count` copies of splats, drawn in proportion to opacity, which share opacity and size with their copies.

    Together they render like the one before (arXiv 2404.09591). Returns how many were added.
    """
    if count <= 0:
        return 0
    opacities = torch.sigmoid(model.opacity)
    picks = draw(opacities, count, stream(model.split_seed, f"copies/{step}"))
    index, inverse, counts = torch.unique(picks, return_inverse=True, return_counts=True)
    shared, scales = shared_among(opacities[index], opacities.new_ones(len(index), 1), counts + 1)
    rows = {name: getattr(model, name).detach()[index] for name in model.ROWS}
    rows["opacity"] = torch.logit(shared.clamp(1e-4, 1 - 1e-6)).clamp(-MOST_OPAQUE, MOST_OPAQUE)
    rows["size"] = rows["size"] + scales[:, 0].log()
    optimizer.set_rows(model, index, {"opacity": rows["opacity"], "size": rows["size"]}, forget=index[:0])
    optimizer.append_rows(model, {name: values[inverse] for name, values in rows.items()})
    return count
