"""Stage 2: the student learns from a frozen teacher, and each Gaussian whether it needs SH degree 3."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

from sw_gaussians.finetune.distillation import DistillationStage, PseudoViewSampler
from sw_gaussians.finetune.importance import KeepImportance

from splatwizard_core.api import (
    CameraIterator,
    ConfigError,
    GaussianModel,
    LossPack,
    ParamGroup,
    Pruner,
    SplatOptimizer,
)
from sw_chimerags.model import MaskedGaussians, MaskQuantizer

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    from splatwizard_core.api import (
        CameraSampler,
        OptimizationParams,
        PipelineParams,
        RenderResult,
        Scene,
        Scheduler,
        SplatModel,
        StageContext,
        View,
    )
    from sw_chimerags.config import ChimeraConfig

STUDENT = "student_initial"


class MaskedDistillation(DistillationStage):
    """`DistillationStage` with a mask, its penalty, and at the end the importance of each Gaussian.

    quantizer   of the mask
    pruner      whose scores are the importance
    """

    def __init__(self, config: ChimeraConfig, quantizer: MaskQuantizer, pruner: Pruner) -> None:
        own = config.distill
        super().__init__(
            config,
            own.lr,
            distill_loss=own.loss,
            lambda_dssim=own.lambda_dssim,
            pseudo_view_std=own.pseudo_view_std,
            pseudo_view_every=3 if own.pseudo_views else 1,
        )
        if pruner.uses_statistics:
            raise ConfigError(
                f"score.pruner '{config.score.pruner}' reads statistics of a densification; there is none here",
                key="score.pruner",
            )
        self.config, self.quantizer, self.pruner = config, quantizer, pruner

    @property
    def iterations(self) -> int:
        """Never more than `iterations`, the length of the longest stage: a run that is cut short is short."""
        return min(max(1, round(self.config.distill.iterations * self.config.schedule_scale)), self.config.iterations)

    @property
    def taught_by(self) -> tuple[str, ...]:
        teacher = self.config.distill.teacher
        return () if teacher == STUDENT else (teacher,)

    def find_teacher(self, context: StageContext) -> SplatModel:
        if self.taught_by:
            return super().find_teacher(context)
        model = copy.deepcopy(context.model)
        if isinstance(model, GaussianModel):
            model.active_sh_degree = model.max_sh_degree
        return model.eval().requires_grad_(False)

    def begin(self, context: StageContext) -> SplatModel:
        model = super().begin(context)
        if not isinstance(model, GaussianModel):
            raise ConfigError(
                f"train.method '{self.config.train.method}' trains no explicit Gaussians: chimerags needs "
                "a method that does",
                key="train.method",
            )
        return MaskedGaussians.of(model, quantizer=self.quantizer, init=self.config.mask.init)

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        rates = {**self.rates.of_step(0, scene.extent), "mask_logits": self.config.mask.lr}
        betas = 0.9, self.config.distill.beta2
        return SplatOptimizer(model, [ParamGroup(name, lr, betas=betas) for name, lr in rates.items()])

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        meant_for = self.config.distill.pseudo_view_extent
        std = self.pseudo_view_std * (scene.extent / meant_for if meant_for else 1)
        return PseudoViewSampler(scene.train, generator, std, self.pseudo_view_every)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        rates = self.rates
        if rates.position_init != rates.position_final or rates.decay != 1:  # published: constant
            self.rates_plan = range(self.config.distill.iterations)
            super().register_pre_task(scheduler, ppl, opt)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        scheduler.register_task(self.iterations, KeepImportance(self.pruner), name="calculate importance score")

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        pack = super().loss(model, view, result, background, step)
        mask = result.extras["mask"].mean()
        return LossPack(pack.total + self.config.mask.weight * mask, {**pack.parts, "mask": mask.detach()})

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        """Return the model with the importance of its Gaussians, computed now if a task changed them since."""
        if isinstance(model, MaskedGaussians) and not model.has_importance():
            KeepImportance(self.pruner)(model, CameraIterator(scene.train), self._rasterizer, scene)
        return model
