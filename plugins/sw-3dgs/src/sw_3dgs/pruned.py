"""A trained 3DGS scene pruned to a count of Gaussians by the exact cost of their removal, and trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import Field
from sw_gaussians.choices import Choosing, CodecChoice, PrunerChoice
from sw_gaussians.finetune.fine_tuning import FineTuningRates, FineTuningStage, collect_anew, windows_before
from sw_gaussians.finetune.pruning import PruneByScore, PruneToCount
from sw_gaussians.method import GaussianMethod
from sw_gaussians.sized import FILLING, Sized

if TYPE_CHECKING:
    from splatwizard_core.api import OptimizationParams, PipelineParams, PluginManager, Scheduler, Stage


class Prune(PrunerChoice):
    """The rounds of removal: each takes the same share of what is left."""

    pruner: str = Field("removal", description="whose scores: any registered pruner")
    count: int = Field(0, ge=0, description="Gaussians that are left; 0: the share `keep`")
    keep: float = Field(0.25, gt=0, le=1, description="share of the Gaussians that is left, without a count")
    start: int = Field(100, ge=1, description="first round")
    rounds: int = Field(6, ge=1, description="how many")
    interval: int = Field(700, ge=1, description="steps between rounds")
    window: int = Field(
        99, ge=1, description="for a pruner that reads gradient statistics: steps that collect them before a round"
    )


class Rates(FineTuningRates):
    """Step sizes that fall by ten over the run, all of them."""

    position_init: float = Field(1.6e-5, gt=0, description="of the means at step 0 of the decay, times the extent")
    max_steps: int = Field(10_000, ge=1, description="steps over which the rate of the means decays")
    decay: float = Field(0.912, gt=0, le=1, description="factor on all rates but that of the means, again and again")


class Pruned3DGSConfig(Sized, Choosing):
    """Everything that can be set for pruned-3dgs."""

    FULL_ITERATIONS: ClassVar[int] = 10_000
    FILLED_BY: ClassVar[str] = FILLING

    gaussians: int = Field(0, ge=0, description="the same as `prune.count`; 0: that says")
    iterations: int = Field(10_000, ge=1, description="steps after the trained scene")
    prune: Prune = Field(Prune(), description="what is removed when")
    lr: Rates = Field(Rates(), description="step sizes")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the loss; the rest is that of L1")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")

    def of_size(self, sources: Mapping[str, str]) -> dict[str, Any]:
        changed = super().of_size(sources)
        if not self.gaussians or "prune.count" in sources:
            return changed
        return {**changed, "prune": self.prune.model_copy(update={"count": self.gaussians})}


class PruneStage(FineTuningStage):
    """Rounds of removal with training between and after them; survivors are updated in the step of a round, too."""

    name = "prune"
    starts_from = "3dgs"

    def __init__(self, config: Pruned3DGSConfig, plugins: PluginManager) -> None:
        super().__init__(config, config.lr, lambda_dssim=config.lambda_dssim)
        self.prune = config.prune
        self.pruner = config.prune.load(plugins)
        self.statistics = self.pruner.uses_statistics

    @property
    def removals(self) -> list[int]:
        """Steps of this run; rounds that fall together in a shortened one are one."""
        prune = self.prune
        steps = self.when([prune.start + prune.interval * i for i in range(prune.rounds)])
        assert isinstance(steps, list)
        return sorted({max(1, step) for step in steps})

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        removals, prune = self.removals, self.prune
        if self.statistics:
            collect_anew(scheduler, windows_before(removals, max(1, round(prune.window * self.opt.schedule_scale))))
        task = (
            PruneToCount(self.pruner, removals, prune.count, carry_grad=True)
            if prune.count
            else PruneByScore(self.pruner, 1 - prune.keep ** (1 / len(removals)), carry_grad=True)
        )
        scheduler.register_task(removals, task, name=f"prune by {prune.pruner}")


class Pruned3DGS(GaussianMethod):
    """Growing to two to four times the count and removing what costs least beats growing to the count.

    1. TAKE     a trained 3DGS scene, by any preset (`pretrained.preset=mcmc`), or a .ply
    2. PRUNE    in six rounds, by what the squared error of all training views gains by each single removal
    3. TRAIN    between and long after them without density control, learning rates falling by ten

    Source: our own.
    """

    name: ClassVar[str] = "pruned-3dgs"
    version: ClassVar[int] = 1
    Config = Pruned3DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "paper": {},
        # For a CPU and the demo scene: a tenth of the steps, from the quick preset of 3dgs at its step sizes.
        "quick": {
            "iterations": 1000,
            "scale_schedule": True,
            "lr.position_init": 8e-5,
            "lr.position_final": 8e-6,
            "lr.sh_dc": 1e-2,
            "lr.sh_rest": 1e-3,
            "lr.scales": 1e-2,
            "lr.quats": 2e-3,
        },
    }
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "r1": {"prune.keep": 0.08},
        "r2": {"prune.keep": 0.15},
        "r3": {"prune.keep": 0.25},
        "r4": {"prune.keep": 0.4},
        "r5": {"prune.keep": 0.6},
    }
    DEFAULT_RATE: ClassVar[str] = "r3"

    def stages(self) -> Sequence[Stage]:
        return [PruneStage(self.config, self.plugins)]
