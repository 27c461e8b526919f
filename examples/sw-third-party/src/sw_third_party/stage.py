"""The training stage: starts from a trained 3DGS scene, prunes once, trains on."""

import torch
from splatwizard_core.api import GaussianModel, OptimizationParams, PipelineParams, Scheduler, SplatOptimizer
from sw_gaussians.finetune.fine_tuning import FineTuningStage
from sw_gaussians.finetune.pruning import lowest, removal_count

from sw_third_party.config import OpacityPruneConfig
from sw_third_party.score import worth


class OpacityPruneStage(FineTuningStage):
    """3DGS without densification, with one removal at the first step."""

    name = "opacity-prune"
    starts_from = "3dgs"
    opt: OpacityPruneConfig

    def __init__(self, opt: OpacityPruneConfig) -> None:
        super().__init__(opt, opt.lr)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_pre_task(scheduler, ppl, opt)
        scheduler.register_task(1, self.prune, name="prune by opacity")

    @torch.no_grad()
    def prune(self, model: GaussianModel, optimizer: SplatOptimizer) -> None:
        """Remove all but the share `keep`, and at least leave one."""
        scores = worth(model.opacities)
        count = min(removal_count(len(scores), 1 - self.opt.keep), len(scores) - 1)
        optimizer.keep_rows(model, ~lowest(scores, count))
