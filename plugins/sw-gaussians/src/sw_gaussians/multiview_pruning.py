"""Multi-view consistent pruning: score Gaussians by the badly rendered pixels they cover in several views.

A Gaussian that is bad in one view may help others; one that is bad in several is pruned (`fast_tasks.PruneByViews`).
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
"""Normalised error (0..1 within a view) above which a pixel counts as badly rendered."""
OUTLIER_SHARE = 0.001
"""Share of the Gaussians whose scores are clipped to 1."""


def normalized_scores(scores: Tensor) -> Tensor:
    """Scale scores [N] to 0..1: the least is 0, the 99.9 % quantile and all above it are 1.

    If that quantile equals the least score, the largest becomes 1, as in the paper; elsewhere one outlier would set
    the scale. Scores that are not finite count as 0.
    """
    scores = scores.nan_to_num(0.0, 0.0, 0.0)
    low, most = scores.aminmax()
    # Not torch.kthvalue, which a GPU refuses where algorithms must be deterministic.
    high = scores.sort().values[math.ceil((1 - OUTLIER_SHARE) * len(scores)) - 1]
    high = torch.where(high > low, high, most)
    return ((scores - low) / (high - low).clamp_min(1e-30)).clamp_(0, 1)


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
    """Return scores [N] float32: sum over views of a Gaussian's badly rendered pixels times the view's loss.

    background  [3] of the training, 0..1
    threshold   a pixel is badly rendered if its error exceeds this: mean over channels of |render - image|, scaled to
                0..1 by the view's least and largest
    clamp       clamp renders to 0..1 first, as a training with `clamp_render` does
    lambda_dssim, padding   of the photometric loss, whatever else a stage adds to its own

    A Gaussian covers a pixel if its alpha is at least 1/255 before the pixel is opaque. Renders each view twice, no
    gradient. Raises ValueError without views, CapabilityError of a rasterizer that does not count.
    """
    if not views:
        raise ValueError("multi-view scores need at least one view")
    device = background.device
    scores = torch.zeros(model.num_rows, device=device)
    for view in views:
        camera = view.camera.to(device)
        inputs = model.gaussians(camera, rasterizer)
        image = rasterizer.render(inputs, camera, RasterOptions(background=background)).image
        image = image.clamp(0, 1) if clamp else image
        truth = view.image(background, device)
        hits = ScoreSpec("hits", "hits", pixel_weight=badly_drawn(image, truth, threshold))
        drawn = rasterizer.render(inputs, camera, RasterOptions(background=background, scores=(hits,))).scores["hits"]
        scores += photometric_loss(image, truth, lambda_dssim=lambda_dssim, padding=padding).total * drawn
    return scores


def badly_drawn(image: Tensor, truth: Tensor, threshold: float) -> Tensor:
    """Return [H,W] bool: pixels whose error, scaled to 0..1 in this view, exceeds the threshold; images [3,H,W]."""
    error = (image - truth).abs().mean(dim=0)
    low, high = error.min(), error.max()
    return (error - low) > threshold * (high - low)


def draw_views(views: Sequence[View], count: int, generator: torch.Generator) -> list[View]:
    """Sample `count` views without replacement, or all if there are fewer."""
    return [views[int(i)] for i in torch.randperm(len(views), generator=generator)[:count]]
