"""The contract of pruners."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from torch import Tensor

from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.scene.camera import Camera


class Pruner(Protocol):
    """Scores primitives; the caller decides how many are removed.

    What is registered is a class whose settings all have defaults, so that any method can use any pruner.
    One that needs photographs also has `score_views(model, views, rasterizer, background)`, called in place of `score`.

    uses_statistics     the score reads the model's screen-space gradient statistics (`grad_accum`, `denom`): whoever
                        uses this pruner has them collected in the steps before
    """

    uses_statistics: bool

    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """Return scores [N] float, one per row of the model, higher = keep; -inf for rows that no camera sees.

        background  [3] what the scene is drawn on, 0..1; None: black

        Leaves the model as it is, gradients included. Every camera counts once, whatever the order.
        """
        ...
