"""The two training stages: prune and recover, then distil into fewer SH bands."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from sw_gaussians.adam_moments import restore_moments
from sw_gaussians.finetune.distillation import DistillationStage
from sw_gaussians.finetune.fine_tuning import FineTuningStage
from sw_gaussians.finetune.importance import KeepImportance, ScoredGaussians
from sw_gaussians.finetune.pruning import PruneByScore
from sw_gaussians.statistics import collect_statistics
from sw_gaussians.surfels import refuse_surfels

from splatwizard_core.api import ConfigError, GaussianModel, Pruner
from sw_lightgaussian.config import LightGaussianConfig

if TYPE_CHECKING:
    from splatwizard_core.api import (
        OptimizationParams,
        PipelineParams,
        Scene,
        Scheduler,
        SplatModel,
        SplatOptimizer,
        StageContext,
    )

log = logging.getLogger(__name__)


class PruneStage(FineTuningStage):
    """Removes the least significant Gaussians of a trained 3DGS scene at its first step, and trains the others on."""

    name = "prune"
    starts_from = "3dgs"
    rates_plan = range(5_000)

    def __init__(self, config: LightGaussianConfig, pruner: Pruner) -> None:
        super().__init__(config, config.prune.lr, lambda_dssim=config.lambda_dssim)
        self.config, self.pruner = config, pruner
        self.statistics = pruner.uses_statistics

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        optimizer = super().create_optimizer(model, scene)
        if self.config.prune.optimizer == "restored" and not restore_moments(model, optimizer):
            log.info("the scene that pruning starts from came without Adam's moments: they start afresh")
        return optimizer

    @property
    def iterations(self) -> int:
        """Never more than `iterations`, the length of the longer stage: a run that is cut short is short."""
        return min(max(1, round(self.config.prune.iterations * self.opt.schedule_scale)), self.opt.iterations)

    def fractions(self) -> dict[int, float]:
        """Step of this run -> share that goes."""
        prune = self.config.prune
        steps = self.when(list(prune.steps))
        assert isinstance(steps, list)
        if len(set(steps)) < len(prune.steps) or min(steps, default=1) < 1:
            raise ConfigError(
                f"prune.steps {prune.steps} must be steps from 1 on that do not fall together in this run",
                key="prune.steps",
            )
        return {step: prune.percent * prune.decay**i for i, step in enumerate(sorted(steps))}

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        fractions = self.fractions()
        if self.statistics and fractions:
            scheduler.register_task(range(max(fractions) + 1), collect_statistics, name="collect gradient statistics")
        steps = list(fractions)
        when = steps[0] if len(steps) == 1 else steps
        task = PruneByScore(self.pruner, fractions, count_rule=self.config.prune.count_rule)
        scheduler.register_task(when, task, name="prune")


class DistillStage(DistillationStage):
    """Drops the highest SH bands and learns from the renders of the unpruned scene, also from moved poses."""

    taught_by = ("3dgs",)
    rates_plan = range(5_000)

    def __init__(self, config: LightGaussianConfig, significance: Pruner) -> None:
        distill = config.distill
        super().__init__(
            config,
            distill.lr,
            distill_loss=distill.loss,
            lambda_dssim=config.lambda_dssim,
            pseudo_view_std=distill.pseudo_view_std,
            pseudo_view_every=3 if distill.pseudo_views else 1,
        )
        self.sh_degree, self.significance = distill.sh_degree, significance

    def begin(self, context: StageContext) -> SplatModel:
        """Return the model with its lower bands, before there is an optimizer: what is cut later is never trained."""
        model = super().begin(context)
        assert isinstance(model, GaussianModel)
        return truncated(model, self.sh_degree)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        # The last step makes no update, so the score belongs to the parameters that are encoded.
        scheduler.register_task(self.iterations, KeepImportance(self.significance), name="calculate importance score")


def truncated(model: GaussianModel, degree: int) -> ScoredGaussians:
    """The Gaussians without the SH bands above `degree`; copies. Raises UserInputError for surfels."""
    refuse_surfels(model, "method lightgaussian")
    degree = min(degree, model.max_sh_degree)
    rest = model.sh_rest[:, : (degree + 1) ** 2 - 1]
    tensors = (model.means, model.sh_dc, rest, model.opacity_logits, model.log_scales, model.quats)
    return ScoredGaussians(*(t.detach().clone() for t in tensors))
