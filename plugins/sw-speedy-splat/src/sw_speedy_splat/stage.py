"""The training stage of Speedy-Splat: that of 3DGS, with removals between and behind its own tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sw_gaussians.control_tasks import Adjust, Change
from sw_gaussians.finetune.pruning import PruneByScore
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.statistics import collect_statistics
from sw_gaussians.wrapped_stage import WrappedStage

if TYPE_CHECKING:
    from splatwizard_core.api import Method, OptimizationParams, PipelineParams, PluginManager, Scheduler
    from sw_speedy_splat.config import SpeedySplatConfig

# Order within a step. A reset before the soft removal would make its scores meaningless: no alpha would be left that is
# worth drawing. A pruner that reads the gradient statistics must come before the densification, which clears them.
DENSIFY, SOFT, RESET, HARD = 1, 2, 3, 4
BEFORE_DENSIFY = 0


class SpeedySplatStage(WrappedStage):
    """The stage of 3DGS with two removals more.

    base    the configured method 3dgs, whose one stage it is
    """

    def __init__(self, config: SpeedySplatConfig, base: Method, plugins: PluginManager) -> None:
        (inner,) = base.stages()
        super().__init__(inner, config)
        self.name = "speedy-splat"
        self.config = config
        assert isinstance(inner, ThreeDGSStage)
        self.densify_stop = inner.control.until
        self.pruner = config.prune.load(plugins)

    @property
    def iterations(self) -> int:
        return self.config.iterations

    @property
    def prefer(self) -> tuple[str, ...]:
        return ("speedy", *self.inner.prefer)

    @property
    def soft_plan(self) -> range:
        """Removals while the scene densifies, in steps of the full run."""
        prune = self.config.prune
        return range(prune.start, self._end(min(self.densify_stop, prune.stop)), prune.interval)

    @property
    def hard_plan(self) -> range:
        """Removals after that: the first multiple of the interval after `start` that is not before the end of it."""
        prune = self.config.prune
        past = -(-max(0, self.densify_stop - prune.start) // prune.interval)
        return range(prune.start + past * prune.interval, self._end(prune.stop), prune.interval)

    def _end(self, stop: int) -> int:
        """Nothing is removed at the last step of a run that is cut short: no update would follow to repair it."""
        return stop if self.config.scale_schedule else min(stop, self.config.iterations)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_post_task(scheduler, ppl, opt)
        scheduler.reprioritise(Adjust, DENSIFY)
        scheduler.reprioritise(Change, RESET)
        soft, hard = self.config.prune.soft, self.config.prune.hard
        statistics = self.pruner.uses_statistics
        if self.soft_plan and soft > 0:
            scheduler.register_task(
                self.when(self.soft_plan),
                PruneByScore(self.pruner, soft),
                priority=BEFORE_DENSIFY if statistics else SOFT,
                name="soft prune",
            )
        if self.hard_plan and hard > 0:
            if statistics:  # 3DGS collects none any more
                window = range(self.densify_stop, self.hard_plan[-1] + 1)
                scheduler.register_task(self.when(window), collect_statistics, name="collect statistics for the pruner")
            # The survivors are still updated in this step, as in the published code, which prunes after the update.
            prune = PruneByScore(self.pruner, hard, carry_grad=True)
            scheduler.register_task(self.when(self.hard_plan), prune, priority=HARD, name="hard prune")
