"""The training stage: 3DGS without densification from a trained scene, with removals in the first third."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from sw_gaussians.finetune.fine_tuning import FineTuningStage, collect_anew, windows_before
from sw_gaussians.finetune.pruning import PruneByScore, scores_of
from sw_gaussians.statistics import GRADIENT_STATISTICS, collect_statistics

from splatwizard_core.api import (
    CameraIterator,
    EmptyModel,
    GaussianModel,
    Pruner,
    Rasterizer,
    Scene,
    SplatOptimizer,
    TaskLog,
)
from sw_trimming_the_fat.score import doomed, mean_gradients

if TYPE_CHECKING:
    from splatwizard_core.api import (
        OptimizationParams,
        PipelineParams,
        PluginManager,
        Scheduler,
        SplatModel,
        StageContext,
    )
    from sw_trimming_the_fat.config import TrimmingTheFatConfig

log = logging.getLogger(__name__)

OWN = "trimming-the-fat"


class TrimmingStage(FineTuningStage):
    """Ten removals; a Gaussian that survives one is still updated in that step.

    Raises ConfigError for a pruner that is not installed.
    """

    name = "trimming-the-fat"
    starts_from = "3dgs"

    def __init__(self, config: TrimmingTheFatConfig, plugins: PluginManager) -> None:
        super().__init__(config, config.lr, lambda_dssim=config.lambda_dssim)
        self.prune = config.prune
        self.pruner = config.prune.load(plugins)
        self.statistics = self.pruner.uses_statistics and config.prune.statistics == "fresh"

    def begin(self, context: StageContext) -> SplatModel:
        before = context.model
        left_over = {name: getattr(before, name).clone() for name in GRADIENT_STATISTICS if hasattr(before, name)}
        model = super().begin(context)
        if self.prune.statistics == "checkpoint":
            for name, values in left_over.items():
                getattr(model, name).copy_(values)
        return model

    @property
    def removals(self) -> range:
        """Steps of this run."""
        plan = self.when(range(self.prune.start, self.prune.stop, self.prune.interval))
        assert isinstance(plan, range)
        return plan

    @property
    def window(self) -> int:
        """Steps of this run over which gradients are averaged; in a run of hardly any steps at least the first."""
        plan = self.when(range(self.prune.window + 1))
        assert isinstance(plan, range)
        return max(1, plan.stop - 1)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        if self.statistics and self.prune.refresh == "once":
            scheduler.register_task(range(self.window + 1), collect_statistics, name="collect gradient statistics")
        elif self.statistics:
            collect_anew(scheduler, windows_before(self.removals, self.window))
        if self.prune.pruner == OWN:
            window = self.window if self.statistics else None
            rule = PruneBelowBoth(self.pruner, self.prune.level, window, scale=self.opt.schedule_scale)
            scheduler.register_task(self.removals, rule, name="gradient aware prune")
        else:
            by_score = PruneByScore(self.pruner, self.prune.fraction_or_default, carry_grad=True)
            scheduler.register_task(self.removals, by_score, name=f"prune by {self.prune.pruner}")


class PruneBelowBoth:
    """Schedule task: removes what lies below the level's quantile of opacity and of gradient.

    window  steps over which gradients were added up; None: not by this training
    scale   of the plan: `prune.window`, which a message names, is in steps of the full run, 1 / scale of this run's

    Gradients of too few views would make it remove nothing: where a share `level` of the Gaussians has none, the
    quantile is 0 and nothing is below. That is an error as long as more views could be seen, and a warning otherwise.
    """

    def __init__(self, pruner: Pruner, level: float, window: int | None, *, scale: float = 1.0) -> None:
        self.pruner, self.level, self.window, self.scale = pruner, level, window, scale

    def __call__(
        self,
        model: GaussianModel,
        optimizer: SplatOptimizer,
        cameras: CameraIterator,
        rasterizer: Rasterizer,
        scene: Scene,
        step: int,
        told: TaskLog,
    ) -> None:
        scores = scores_of(self.pruner, model, cameras, rasterizer, scene)
        goes = doomed(scores, self.level)
        before, gone = model.num_rows, int(goes.sum())
        if gone == 0 and self.level > 0:
            self._explain(model, len(cameras))
        if gone == before:
            raise EmptyModel(step)
        optimizer.keep_rows(model, ~goes, carry_grad=True)
        told.say(f"removed {gone:,} of {before:,} Gaussians, {before - gone:,} left")
        told.scalar("pruned", gone)

    def _explain(self, model: GaussianModel, views: int) -> None:
        """Raise, or warn, if too many Gaussians have no gradient for anything to be below the quantile."""
        without = float((mean_gradients(model) == 0).double().mean())
        if without < self.level:
            return
        share = f"{without:.0%} of the Gaussians have no gradient, so nothing lies below the {self.level:g}-quantile"
        if self.window is not None and self.window < views:
            enough = math.ceil((views + 0.5) / self.scale - 1e-9) - 1  # what scales to as many steps as there are views
            raise ValueError(
                f"{share}: {self.window} steps of statistics saw at most {self.window} of {views} training views; "
                f"set prune.window={enough} and prune.start after it"
            )
        seen = "" if self.window is None else ", although every training view was seen"
        log.warning("%s%s: nothing is removed", share, seen)
