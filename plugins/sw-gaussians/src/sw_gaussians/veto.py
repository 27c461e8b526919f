"""Evidence of several views about each Gaussian: in how many badly drawn pixels it takes part.

One view can ask for a Gaussian that others have no use for; what several draw badly needs one. `densify_to_budget`
takes the first score as a veto, `fast_tasks.PruneByViews` the second.
Source: FastGS (arXiv 2511.04283), multi-view consistent densification and pruning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from splatwizard_core.api import (
    Rasterizer,
    RasterOptions,
    ScoreSpec,
    SplatModel,
    View,
    photometric_loss,
)

LOSS_THRESHOLD = 0.1
"""Share of a view's largest error from which a pixel is badly drawn."""
OUTLIERS = 0.001
"""Share of the Gaussians that may have more blame than counts as all of it."""


@dataclass(frozen=True)
class ViewEvidence:
    """Sums over views of how many badly drawn pixels each Gaussian was blended into.

    counts  [N] int64
    blame   [N] float32, each view's pixels times its photometric loss
    views   how many views there were
    """

    counts: Tensor
    blame: Tensor
    views: int

    def wanted(self, least: float) -> Tensor:
        """Return which Gaussians [N] bool are in more than `least` badly drawn pixels a view, rounded down."""
        return torch.div(self.counts, self.views, rounding_mode="floor") > least

    def guilt(self) -> Tensor:
        """Return the blame [N] as a share, 0..1, of that which a thousandth of the Gaussians exceeds.

        Of the largest, as in the paper, where fewer than a thousandth have more than the least; elsewhere one outlier
        would decide it. Blame that is not finite counts as none.
        """
        blame = self.blame.nan_to_num(0.0, 0.0, 0.0)
        low, most = blame.aminmax()
        # Not torch.kthvalue, which a GPU refuses where algorithms must be deterministic.
        high = blame.sort().values[math.ceil((1 - OUTLIERS) * len(blame)) - 1]
        high = torch.where(high > low, high, most)
        return ((blame - low) / (high - low).clamp_min(1e-30)).clamp_(0, 1)


@torch.no_grad()
def view_evidence(
    model: SplatModel,
    views: Sequence[View],
    rasterizer: Rasterizer,
    background: Tensor,
    *,
    threshold: float = LOSS_THRESHOLD,
    clamp: bool = False,
    lambda_dssim: float = 0.2,
    padding: Literal["same", "valid"] = "same",
) -> ViewEvidence:
    """Draw the views, find their badly drawn pixels, and count those of each Gaussian.

    background  [3] of the training, 0..1
    threshold   a pixel is badly drawn where its absolute error, the mean over channels, brought to 0..1 by the view's
                least and largest, exceeds this
    clamp       bring drawings to 0..1 first, as a training with `clamp_render` does
    lambda_dssim, padding   of the photometric loss, whatever else a stage adds to its own

    A Gaussian takes part where its alpha is at least 1/255, before the pixel is opaque. Two drawings a view, no
    gradient. Raises ValueError without views, CapabilityError of a rasterizer that does not count.
    """
    if not views:
        raise ValueError("evidence of several views needs at least one")
    device = background.device
    counts = torch.zeros(model.num_rows, dtype=torch.int64, device=device)
    blame = torch.zeros(model.num_rows, device=device)
    for view in views:
        camera = view.camera.to(device)
        inputs = model.gaussians(camera, rasterizer)
        image = rasterizer.render(inputs, camera, RasterOptions(background=background)).image
        image = image.clamp(0, 1) if clamp else image
        truth = view.image(background, device)
        hits = ScoreSpec("hits", "hits", pixel_weight=badly_drawn(image, truth, threshold))
        found = rasterizer.render(inputs, camera, RasterOptions(background=background, scores=(hits,)))
        drawn = found.scores["hits"]
        counts += drawn
        blame += photometric_loss(image, truth, lambda_dssim=lambda_dssim, padding=padding).total * drawn
    return ViewEvidence(counts, blame, len(views))


def badly_drawn(image: Tensor, truth: Tensor, threshold: float) -> Tensor:
    """Return the pixels [H,W] bool whose error, of 0..1 in this view, exceeds the threshold; images [3,H,W]."""
    error = (image - truth).abs().mean(dim=0)
    low, high = error.min(), error.max()
    return (error - low) > threshold * (high - low)


def draw_views(views: Sequence[View], count: int, generator: torch.Generator) -> list[View]:
    """Draw `count` views without replacement, or all if there are no more."""
    return [views[int(i)] for i in torch.randperm(len(views), generator=generator)[:count]]
