"""Blame of Gaussians: how much each takes part in the badly drawn pixels of several views.

One view can blame a Gaussian that others have a use for; what several blame is not needed (`fast_tasks.PruneByViews`).
Source: FastGS (arXiv 2511.04283), multi-view consistent pruning.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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


def normalized_scores(blame: Tensor) -> Tensor:
    """Return the blame [N] as a share, 0..1, of that which a thousandth of the Gaussians exceeds.

    Of the largest, as in the paper, where fewer than a thousandth have more than the least; elsewhere one outlier
    would decide it. Blame that is not finite counts as none.
    """
    blame = blame.nan_to_num(0.0, 0.0, 0.0)
    low, most = blame.aminmax()
    # Not torch.kthvalue, which a GPU refuses where algorithms must be deterministic.
    high = blame.sort().values[math.ceil((1 - OUTLIERS) * len(blame)) - 1]
    high = torch.where(high > low, high, most)
    return ((blame - low) / (high - low).clamp_min(1e-30)).clamp_(0, 1)


@torch.no_grad()
def multiview_error_scores(
    model: SplatModel,
    views: Sequence[View],
    rasterizer: Rasterizer,
    background: Tensor,
    *,
    threshold: float = LOSS_THRESHOLD,
    clamp: bool = False,
    lambda_dssim: float = 0.2,
    padding: Literal["same", "valid"] = "same",
) -> Tensor:
    """Return the blame [N] float32: for each view the badly drawn pixels of a Gaussian, times the view's loss.

    background  [3] of the training, 0..1
    threshold   a pixel is badly drawn where its absolute error, the mean over channels, brought to 0..1 by the view's
                least and largest, exceeds this
    clamp       bring drawings to 0..1 first, as a training with `clamp_render` does
    lambda_dssim, padding   of the photometric loss, whatever else a stage adds to its own

    A Gaussian takes part where its alpha is at least 1/255, before the pixel is opaque. Two drawings a view, no
    gradient. Raises ValueError without views, CapabilityError of a rasterizer that does not count.
    """
    if not views:
        raise ValueError("the blame of several views needs at least one")
    device = background.device
    blame = torch.zeros(model.num_rows, device=device)
    for view in views:
        camera = view.camera.to(device)
        inputs = model.gaussians(camera, rasterizer)
        image = rasterizer.render(inputs, camera, RasterOptions(background=background)).image
        image = image.clamp(0, 1) if clamp else image
        truth = view.image(background, device)
        hits = ScoreSpec("hits", "hits", pixel_weight=badly_drawn(image, truth, threshold))
        drawn = rasterizer.render(inputs, camera, RasterOptions(background=background, scores=(hits,))).scores["hits"]
        blame += photometric_loss(image, truth, lambda_dssim=lambda_dssim, padding=padding).total * drawn
    return blame


def badly_drawn(image: Tensor, truth: Tensor, threshold: float) -> Tensor:
    """Return the pixels [H,W] bool whose error, of 0..1 in this view, exceeds the threshold; images [3,H,W]."""
    error = (image - truth).abs().mean(dim=0)
    low, high = error.min(), error.max()
    return (error - low) > threshold * (high - low)


def draw_views(views: Sequence[View], count: int, generator: torch.Generator) -> list[View]:
    """Draw `count` views without replacement, or all if there are no more."""
    return [views[int(i)] for i in torch.randperm(len(views), generator=generator)[:count]]
