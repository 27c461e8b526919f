"""Hyper-parameters of anchor methods. Defaults are those of Scaffold-GS as HAC trains it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import Field
from sw_gaussians.pictures import Pictures

from splatwizard_core.api import OptimizationParams, Params

RANDOM_START: Mapping[str, Any] = {
    "init_points": 100_000,
    "visible_offsets": 5,
    "random_background_until": 1_500,
    "lr.mlp_opacity_early": 0.1,
}
"""Initialisation for scenes in the Blender layout, which usually have no points (docs/methods/hac.md).

The code of HAC samples 10,000 points, or takes the 100,000 points of an earlier 3DGS training if the folder has them.
The published results match the latter.
"""


class AnchorLearningRates(Params):
    """Adam step sizes; from `init` to `final` exponentially over `max_steps`."""

    max_steps: int = Field(30_000, ge=1, description="steps over which the rates decay")
    offsets_init: float = Field(0.01, gt=0, description="of the offsets at step 0, times the scene extent")
    offsets_final: float = Field(1e-4, gt=0, description="of the offsets at step `max_steps`, times the scene extent")
    features: float = Field(0.0075, ge=0, description="of the anchor features, constant")
    scales: float = Field(0.007, ge=0, description="of the log scales, constant")
    mlp_opacity_init: float = Field(0.002, gt=0, description="of the opacity network at step 0")
    mlp_opacity_final: float = Field(2e-5, gt=0, description="of the opacity network at `max_steps`")
    mlp_opacity_early: float | None = Field(
        1.0, gt=0, le=1,
        description="factor on the opacity network's rate up to `early_until`; None: 1, or 0.3 below 50,000 points",
    )  # fmt: skip
    early_until: int = Field(1_500, ge=0, description="last step that `mlp_opacity_early` applies to")
    mlp_cov_init: float = Field(0.004, gt=0, description="of the covariance network at step 0")
    mlp_cov_final: float = Field(0.004, gt=0, description="of the covariance network at `max_steps`")
    mlp_color_init: float = Field(0.008, gt=0, description="of the colour network at step 0")
    mlp_color_final: float = Field(5e-5, gt=0, description="of the colour network at `max_steps`")


class CodedAnchorLearningRates(AnchorLearningRates):
    """Adam step sizes, with those of the offset masks."""

    masks_init: float = Field(0.01, gt=0, description="of the mask logits at step 0, times the scene extent")
    masks_final: float = Field(1e-4, gt=0, description="of the mask logits at `max_steps`, times the scene extent")


class AnchorGrowth(Params):
    """Growing and pruning of anchors."""

    start: int = Field(1_500, ge=0, description="first step that adjusts anchors (authors' code: 1600)")
    pause_start: int = Field(3_000, ge=0, description="no adjustment from this step on ...")
    pause_end: int = Field(4_000, ge=0, description="... until this one: the model gets used to noise")
    stop: int = Field(15_000, ge=0, description="no adjustment and no statistics from this step on")
    start_stat: int = Field(500, ge=0, description="statistics of steps up to this one are dropped")
    interval: int = Field(100, ge=1, description="steps between adjustments")
    success: float = Field(
        0.8, gt=0, description="an anchor counts once seen in more than interval x success views, an offset in half"
    )
    grad_threshold: float = Field(2e-4, gt=0, description="mean gradient of an offset that grows an anchor, NDC units")
    min_opacity: float = Field(0.005, ge=0, description="anchors whose offsets sum to less go, mean over views")
    levels: int = Field(3, ge=1, le=8, description="cell sizes at which anchors appear")
    init_factor: int = Field(16, ge=1, description="size of the coarsest cells, voxels")
    hierarchy: int = Field(4, ge=1, description="ratio of cell sizes from level to level")
    subvoxel: bool = Field(False, description="levels with cells below a voxel grow too (authors: they do not)")

    @property
    def whole_voxels(self) -> bool:
        """Whether cells of all levels are whole voxels, which makes `subvoxel` irrelevant."""
        return all(self.init_factor % self.hierarchy**level == 0 for level in range(self.levels))

    def normal(self, plugins: Any) -> AnchorGrowth:
        found = super().normal(plugins)
        return found.model_copy(update={"subvoxel": False}) if self.whole_voxels else found


class AnchorLoss(Params):
    """Distortion and regularisers of the loss."""

    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM; the rest is the weight of L1")
    volume: float = Field(0.01, ge=0, description="weight of the mean volume of a drawn Gaussian (product of scales)")


class AnchorParams(OptimizationParams):
    """Base of the hyper-parameters of an anchor method."""

    REFUSES: ClassVar = {"gaussians": "it trains anchors, whose offsets are its Gaussians: --size bounds the file"}
    voxel_size: float = Field(0.001, description="edge of an anchor's cell, world units; <= 0: from the points")
    num_offsets: int = Field(10, ge=1, le=64, description="Gaussians per anchor")
    feature_dim: int = Field(50, ge=1, le=256, description="numbers in an anchor's feature")
    hidden: int = Field(50, ge=1, le=256, description="width of the networks that decode Gaussians")
    visible_offsets: int = Field(
        0,
        ge=0,
        description="Gaussians per anchor that the first opacity network shows, at most half of them; 0: as its random "
        "weights have it, as published: 1 to 9 of 10 by seed, the same for all anchors",
    )
    random_background_until: int = Field(
        0,
        ge=0,
        description="a fresh background colour per step up to this one, so that black anchors in empty space are seen",
    )
    lr: AnchorLearningRates = Field(AnchorLearningRates(), description="step sizes")
    growth: AnchorGrowth = Field(AnchorGrowth(), description="growing and pruning of anchors")
    loss: AnchorLoss = Field(AnchorLoss(), description="distortion and regularisers")
    pictures: Pictures = Field(Pictures(), description="sizes of the training pictures")


class CodedAnchorParams(AnchorParams):
    """Hyper-parameters of a method whose anchors have masks and a rate, to be subclassed."""

    ABSENT: ClassVar[Mapping[str, Any]] = {"growth.subvoxel": True}

    lr: CodedAnchorLearningRates = Field(CodedAnchorLearningRates(), description="step sizes")
