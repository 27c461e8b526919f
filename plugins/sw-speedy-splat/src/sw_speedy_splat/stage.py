"""How Speedy-Splat trains: the stage of 3DGS, taken over as it is, with removals between and behind its own tasks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sw_finetuning.pruning import PruneByScore
from sw_gaussians.statistics import accumulate_statistics

from splatwizard_core.api import GaussianModel, RenderResult, Scheduler, Stage, When, load_pruner
from splatwizard_core.training.plan import scaled

if TYPE_CHECKING:
    from collections.abc import Callable

    import torch
    from torch import Tensor

    from splatwizard_core.api import (
        CameraSampler,
        LossPack,
        Method,
        OptimizationParams,
        PipelineParams,
        PluginManager,
        RasterOptions,
        Scene,
        SplatModel,
        SplatOptimizer,
        StageContext,
        View,
    )
    from sw_speedy_splat.config import SpeedySplatConfig

OWN = "speedy-splat"

# Order within a step. A reset before the soft removal would make its scores meaningless: no alpha would be left that is
# worth drawing. A pruner that reads the gradient statistics must come before the densification, which clears them.
DENSIFY, SOFT, RESET, HARD = 1, 2, 3, 4
BEFORE_DENSIFY = 0


class SpeedySplatStage(Stage):
    """Everything that this class does not say itself is what the stage of 3DGS does.

    base    the configured method 3dgs, whose one stage it is
    """

    name = "speedy-splat"

    def __init__(self, config: SpeedySplatConfig, base: Method, plugins: PluginManager) -> None:
        super().__init__(config)
        self.config, self.plugins = config, plugins
        (self.base,) = base.stages()
        self.densify_stop: int = base.config.densify.stop
        self.pruner = load_pruner(plugins, config.prune.pruner, {OWN: {"channel_mode": config.prune.channel_mode}})

    def when(self, when: When) -> When:
        """A plan of the full run, in steps of this one."""
        return scaled(when, self.config.schedule_scale)

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

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        self.base.register_pre_task(scheduler, ppl, opt)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        tasks = self.plugins.tasks
        later = {tasks.load("prune-and-densify"): DENSIFY, tasks.load("reset-opacity"): RESET}
        self.base.register_post_task(_Ordered(scheduler, later), ppl, opt)
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

    # What follows is the stage of 3DGS.

    @property
    def prefer(self) -> tuple[str, ...]:
        return ("speedy", *self.base.prefer)

    def begin(self, context: StageContext) -> SplatModel:
        return self.base.begin(context)

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        return self.base.create_optimizer(model, scene)

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        return self.base.create_sampler(scene, generator)

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        return self.base.raster_options(step, background)

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        return self.base.loss(model, view, result, background, step)

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        return self.base.finish(model, scene)


class _Ordered(Scheduler):
    """Passes tasks on to another scheduler, some with a later priority: room between the tasks of a borrowed stage.

    later   class of a task -> what is added to its priority
    """

    def __init__(self, inner: Scheduler, later: dict[type, int]) -> None:
        super().__init__(inner.stage)
        self.inner, self.later = inner, later

    def register_task(
        self,
        when: When,
        task: Callable[..., Any],
        *,
        priority: int = 0,
        name: str | None = None,
        log: bool = False,
    ) -> None:
        self.inner.register_task(when, task, priority=priority + self.later.get(type(task), 0), name=name, log=log)


def collect_statistics(model: GaussianModel, result: RenderResult) -> None:
    """Adds this view's screen-space gradients, of whichever kind 3DGS asked for, to the model's statistics."""
    gradients = result.grad2d or result.absgrad2d
    if gradients is None:
        raise ValueError("a pruner that reads gradient statistics needs a base that renders them (not mcmc.enabled)")
    accumulate_statistics(model, gradients.value, result.radii)
