"""The training stage: rounds of 3DGS without densification, each with a removal at its first step and fresh Adam."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sw_gaussians.finetune.fine_tuning import FineTuningStage, collect_anew, windows_before
from sw_gaussians.finetune.pruning import PruneByScore

from splatwizard_core.api import ConfigError, SplatOptimizer

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from splatwizard_core.api import OptimizationParams, PipelineParams, PluginManager, Scheduler
    from sw_pup_3dgs.config import Pup3DGSConfig

OWN = "pup-3dgs"


class PupStage(FineTuningStage):
    """Two rounds; nothing is updated in the step of a removal.

    Raises ConfigError for a pruner that is not installed, or a plan in which two rounds fall on one step.
    """

    name = "pup-3dgs"
    starts_from = "3dgs"

    def __init__(self, config: Pup3DGSConfig, plugins: PluginManager) -> None:
        super().__init__(config, config.lr, lambda_dssim=config.lambda_dssim)
        prune = config.prune
        self.prune = prune
        self.pruner = prune.load(plugins)
        self.statistics = self.pruner.uses_statistics
        if len(self.round_starts()) != len(prune.steps) or len(self.removals()) != len(prune.steps):
            raise ConfigError(f"rounds at {prune.steps} are too close together for this run", key="prune.steps")
        late = [at for start, at in zip(self.round_starts(), self.removals(), strict=True) if start < at]
        if late and late[0] > self.iterations:
            raise ConfigError(
                f"the first removal by '{prune.pruner}' would be at step {late[0]}, after {self.window} steps of "
                f"gradient statistics, and the run ends at step {self.iterations}: lower prune.window",
                key="prune.window",
            )

    def round_starts(self) -> Sequence[int]:
        steps = self.when(self.prune.steps)
        assert isinstance(steps, list)
        return steps

    @property
    def window(self) -> int:
        """Steps of this run over which gradients are averaged, for a pruner that reads them."""
        return max(1, round(self.prune.window * self.opt.schedule_scale))

    def removals(self) -> Mapping[int, float]:
        """Step of this run -> share that goes then: where a round begins.

        A pruner that reads gradient statistics must wait until it has some.
        """
        wait = self.window if self.statistics else 0
        return {
            max(step, wait + 1): share for step, share in zip(self.round_starts(), self.prune.fractions, strict=True)
        }

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        scheduler.register_task(list(self.round_starts()), start_round, name="start round")
        super().register_pre_task(scheduler, ppl, opt)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        removals = self.removals()
        if self.statistics:
            collect_anew(scheduler, windows_before(removals, self.window))
        task = PruneByScore(self.pruner, removals, count_rule=self.prune.count_rule)
        name = "PUP prune" if self.prune.pruner == OWN else f"prune by {self.prune.pruner}"
        scheduler.register_task(list(removals), task, name=name)


def start_round(optimizer: SplatOptimizer) -> None:
    """Schedule task: Adam forgets its moments and counts its steps anew, as a new process would."""
    optimizer.load_state_dict({**optimizer.state_dict(), "moments": {}})
