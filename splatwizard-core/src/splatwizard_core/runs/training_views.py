"""PSNR over the views that a model was trained on: test views alone do not say whether it is bad or they are new."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable

import torch
from torch import Tensor

from splatwizard_core.base.progress import track
from splatwizard_core.evaluation.evaluate import INFINITE, NOT_A_NUMBER
from splatwizard_core.evaluation.image import prepare_render, psnr
from splatwizard_core.runs.record import TrainingPsnrBlock
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.images import decoded_ahead
from splatwizard_core.scene.scene import Scene

FAR_BELOW = 8.0  # dB from the median of the training views down to one that is named
SHARE = 0.05  # of the training views that lie at or below `quantile_05`


def training_psnr(
    scene: Scene, draw: Callable[[Camera], Tensor], device: torch.device
) -> tuple[TrainingPsnrBlock | None, dict[str, str]]:
    """Draw every training view once and compare, as `psnr` of the test views is computed.

    draw    camera on `device` -> [3,H,W], not clamped

    Returns the summary, or None, and the reason of each null by dotted name.
    """
    if not scene.train:
        return None, {"training_psnr": "the scene has no training views"}
    background, found = scene.background.to(device), dict[str, float]()
    with track(f"training views of {scene.name}", total=len(scene.train), unit="views") as bar:
        for view in decoded_ahead(scene.train):
            image = prepare_render(draw(view.camera.to(device)), quantize8=scene.protocol.quantize8)
            found[view.name] = psnr(image, view.image(background, device))
            bar.advance()
    return summary(found)


def summary(values: dict[str, float]) -> tuple[TrainingPsnrBlock | None, dict[str, str]]:
    """Summarise PSNRs by view name, dB, at least one; returns as `training_psnr` does."""
    if any(map(math.isnan, values.values())):
        return None, {"training_psnr": NOT_A_NUMBER}
    ordered = sorted(values, key=lambda name: values[name])
    median = statistics.median(values.values())
    told = {
        "mean": statistics.fmean(values.values()),
        "median": median,
        "quantile_05": values[ordered[math.ceil(SHARE * len(ordered)) - 1]],
    }
    finite = {name: value if math.isfinite(value) else None for name, value in told.items()}
    reasons = {f"training_psnr.{name}": INFINITE for name, value in finite.items() if value is None}
    far = [name for name in ordered if math.isfinite(median) and values[name] < median - FAR_BELOW]
    return TrainingPsnrBlock(**finite, far_below={name: values[name] for name in far}), reasons
