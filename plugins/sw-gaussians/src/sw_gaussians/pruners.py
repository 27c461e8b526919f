"""Pruner by opacity, the baseline of all others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from splatwizard_core.api import GaussianModel

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import Camera, Rasterizer, SplatModel


class Opacity:
    """Scores each Gaussian by its opacity; needs no view."""

    uses_statistics = False

    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """Return opacities [N], 0..1. Raises TypeError for a model without opacities."""
        if not isinstance(model, GaussianModel):
            raise TypeError(f"the pruner 'opacity' scores a GaussianModel, not a {type(model).__name__}")
        return model.opacities.detach()
