"""Gaussians with an importance score each, for codecs that spend more bits on important ones."""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import CameraIterator, GaussianModel, Pruner, Rasterizer, Scene
from sw_gaussians.finetune.pruning import scores_of


class ScoredGaussians(GaussianModel):
    """Gaussians with an importance score per row.

    importance  [N] buffer, higher = more important; zeros until `set_importance`
    """

    ROWS = (*GaussianModel.ROWS, "importance")

    importance: Tensor

    def __init__(self, *tensors: Tensor, active_sh_degree: int | None = None) -> None:
        super().__init__(*tensors, active_sh_degree=active_sh_degree)
        self.register_buffer("importance", torch.zeros_like(self.opacity_logits))

    @torch.no_grad()
    def set_importance(self, scores: Tensor) -> None:
        """Store a pruner's scores [N]; negative ones, and -inf of Gaussians no view shows, become 0."""
        self.importance.copy_(scores.clamp_min(0))


class KeepImportance:
    """Schedule task: score every Gaussian over the training views and store the scores in the model.

    At the last step of a stage, which makes no update, the scores are those of the parameters that are encoded.
    """

    def __init__(self, pruner: Pruner) -> None:
        self.pruner = pruner

    def __call__(self, model: ScoredGaussians, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene) -> None:
        model.set_importance(scores_of(self.pruner, model, cameras, rasterizer, scene))
