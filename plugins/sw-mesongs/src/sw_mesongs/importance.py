"""Pruner `mesongs`: how much each Gaussian contributes to the training views, times a power of its volume.

Source: MesonGS (arXiv 2409.09756), section on universal Gaussian pruning, and facts about the authors' code.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from pydantic import Field
from sw_gaussians.finetune.volume import volume_factor

from splatwizard_core.api import GaussianModel, Params, RasterOptions, ScoreSpec

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera, Rasterizer, SplatModel

BETA = 0.1


class ImportanceSettings(Params):
    """Settings of the pruner `mesongs`."""

    beta: float | None = Field(
        None, ge=0, description="power of the volume; unset: 0.1, in the method mesongs the published one of the scene"
    )


class Importance:
    """Sum of alpha x transmittance over every pixel of every view, times (volume / reference)^beta.

    beta    power of the volume; None: 0.1. The reference is the volume that 90 % of the Gaussians exceed
    """

    Settings = ImportanceSettings
    uses_statistics = False

    def __init__(self, *, beta: float | None = None) -> None:
        self.beta = beta

    @torch.no_grad()
    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """Return the scores [N] float64 >= 0, 0 for what no camera sees.

        Raises TypeError for a model without Gaussians of its own.
        """
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'mesongs' scores a GaussianModel, not a {type(model).__name__}")
        options = RasterOptions(background=background, scores=(ScoreSpec("contribution", "blend"),))
        found = torch.zeros(model.num_rows, dtype=torch.float64, device=model.device)
        for camera in cameras:
            camera = camera.to(model.device)
            # One view at a time: a rasterizer returns its sums as float32.
            found += rasterizer.accumulate(model.gaussians(camera, rasterizer), [camera], options).scores[
                "contribution"
            ]
        return found * volume_factor(model.log_scales.double(), BETA if self.beta is None else self.beta)
