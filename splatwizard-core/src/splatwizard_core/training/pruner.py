"""The face of the pruners that plugins provide."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.scene.camera import Camera


class Pruner(Protocol):
    """Scores primitives; how many go is the caller's business."""

    def score(self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer) -> Tensor:
        """[N] float32, one for each row of the model, higher = keep."""
        ...
