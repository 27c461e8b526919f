"""PSNR between what two models show, or between a model and pictures, over the same cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from sw_gaussians.picture_psnr import capped_psnr
from torch import Tensor

from splatwizard_core.api import track

if TYPE_CHECKING:
    from splatwizard_core.api import Camera, View
    from sw_view.drawing import Drawing


def mean_psnr(drawing: Drawing, cameras: Sequence[Camera], other: Drawing | Callable[[int], Tensor]) -> float:
    """Return the mean over the cameras of the PSNR, dB, of what a model shows, values clamped to 0..1.

    other   what it is compared with: another model, or (index of the camera) -> [3,H,W]
    """
    total = 0.0
    with track("compare", total=len(cameras), unit="views") as bar:
        for i, camera in enumerate(cameras):
            shown = drawing.render(camera).image.clamp(0, 1)
            truth = other(i) if callable(other) else other.render(camera).image.clamp(0, 1)
            total += capped_psnr(shown, truth)
            bar.advance()
    return total / len(cameras)


def truth_of(drawing: Drawing, views: Sequence[View]) -> Callable[[int], Tensor]:
    """Return the pictures of the views as `mean_psnr` takes them."""
    return lambda i: views[i].image(drawing.options.background, drawing.device)
