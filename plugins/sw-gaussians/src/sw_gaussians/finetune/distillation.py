"""Distillation: a student learns from renders of a frozen teacher, also at poses without a photograph.

Source: LightGaussian (arXiv 2311.17245), distillation with pseudo views.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from splatwizard_core.api import (
    CameraSampler,
    LossPack,
    OptimizationParams,
    RasterOptions,
    RenderResult,
    Scene,
    SplatModel,
    StageContext,
    View,
    photometric_loss,
)
from sw_gaussians.finetune.fine_tuning import FineTuningRates, FineTuningStage

DistillLoss = Literal["l1_ssim", "l2"]


class PseudoViewSampler(CameraSampler):
    """Samples training poses, most with a small random offset, for the teacher to render.

    std     standard deviation of the camera centre's displacement along each axis, world units
    every   each `every`-th step keeps the training view as it is, the others move it; 1: none is moved

    The orientation is kept, and so is the training view itself: it is a new camera that moves.
    """

    def __init__(self, views: list[View], generator: torch.Generator, std: float, every: int = 3) -> None:
        super().__init__(views, generator)
        if std < 0 or every < 1:
            raise ValueError(f"pseudo views need std >= 0 and every >= 1, got {std} and {every}")
        self.std, self.every = std, every

    def next(self, step: int) -> View:
        view = super().next(step)
        if step % self.every == 0:
            return view
        shift = (self.std * torch.randn(3, generator=self.generator)).to(view.camera.tau)
        # tau = -R centre, so this moves the centre by `shift`, and by exactly nothing where that is zero.
        return View(replace(view.camera, tau=view.camera.tau - view.camera.R @ shift), name=f"{view.name} (moved)")


def distillation_loss(
    image: Tensor, target: Tensor, kind: DistillLoss = "l1_ssim", lambda_dssim: float = 0.2
) -> LossPack:
    """Return the loss between the student's and the teacher's render.

    image, target   [3,H,W]; `target` without gradient
    kind            "l1_ssim": the 3DGS loss between the two; "l2": their mean squared difference
    lambda_dssim    weight of 1 - SSIM in "l1_ssim"
    """
    if kind == "l1_ssim":
        return photometric_loss(image, target, lambda_dssim=lambda_dssim)
    squared = (image - target).square().mean()
    return LossPack(squared, {"l2": squared.detach()})


class DistillationStage(FineTuningStage):
    """Continues the previous stage with a trained scene as teacher; uses no photographs.

    rates           step sizes of the student
    distill_loss    see `distillation_loss`
    pseudo_view_std, pseudo_view_every  see PseudoViewSampler
    teacher         the model that teaches, set by `begin`; in no checkpoint, since `begin` finds the same one on resume
    """

    name = "distill"
    teacher: SplatModel

    def __init__(
        self,
        opt: OptimizationParams,
        rates: FineTuningRates,
        *,
        distill_loss: DistillLoss = "l1_ssim",
        lambda_dssim: float = 0.2,
        pseudo_view_std: float = 0.05,
        pseudo_view_every: int = 3,
    ) -> None:
        super().__init__(opt, rates, lambda_dssim=lambda_dssim)
        self.distill_loss = distill_loss
        self.pseudo_view_std, self.pseudo_view_every = pseudo_view_std, pseudo_view_every

    def find_teacher(self, context: StageContext) -> SplatModel:
        """Return the frozen teacher: the trained scene of the method in `taught_by`, which a subclass sets.

        Override it for a teacher that is no method's trained scene. It must be the same on resume: made from
        `context.trained(...)`, or a copy of `context.model`, which is what the stage before left.
        """
        return context.trained(self.taught_by[0])

    def begin(self, context: StageContext) -> SplatModel:
        self.teacher = self.find_teacher(context)
        self._rasterizer, self._clamp = context.rasterizer, context.ppl.clamp_render
        return super().begin(context)

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        return PseudoViewSampler(scene.train, generator, self.pseudo_view_std, self.pseudo_view_every)

    @torch.no_grad()
    def teach(self, view: View, background: Tensor) -> Tensor:
        """Return the teacher's render [3,H,W], at its own SH degree, on the student's background."""
        camera = view.camera.to(background.device)
        drawn = self.teacher.gaussians(camera, self._rasterizer)
        image = self._rasterizer.render(drawn, camera, RasterOptions(background=background)).image
        return image.clamp(0, 1) if self._clamp else image

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        target = self.teach(view, background)
        return distillation_loss(result.image, target, self.distill_loss, self.lambda_dssim)
