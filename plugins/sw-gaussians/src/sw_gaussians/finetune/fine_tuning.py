"""Fine-tuning of trained Gaussians without densification, as pruning methods do between removals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pydantic import Field
from torch import Tensor

from splatwizard_core.api import (
    GaussianModel,
    LossPack,
    OptimizationParams,
    ParamGroup,
    Params,
    PipelineParams,
    RasterOptions,
    RenderResult,
    Scene,
    Scheduler,
    SplatModel,
    SplatOptimizer,
    Stage,
    StageContext,
    View,
    photometric_loss,
)
from sw_gaussians.learning_rate import exponential_lr
from sw_gaussians.statistics import clear_statistics, collect_statistics

CLEAR = -1  # before the same step's statistics are added


class FineTuningRates(Params):
    """Adam step sizes of the six parameter groups of Gaussians that are already trained.

    Defaults: where the exponential schedule of 3DGS ends, everything else as in 3DGS.
    """

    position_init: float = Field(1.6e-6, gt=0, description="of the means at step 0 of the decay, times the extent")
    position_final: float = Field(1.6e-6, gt=0, description="of the means at its end, times the extent")
    position_offset: int = Field(0, ge=0, description="steps of the decay that lie before this stage")
    max_steps: int = Field(30_000, ge=1, description="steps over which the rate of the means decays")
    sh_dc: float = Field(2.5e-3, ge=0, description="of SH band 0")
    sh_rest: float = Field(1.25e-4, ge=0, description="of SH bands 1 to 3 (band 0 / 20)")
    opacity: float = Field(0.05, ge=0, description="of the opacity logits; 0: frozen")
    scales: float = Field(5e-3, ge=0, description="of the log scales")
    quats: float = Field(1e-3, ge=0, description="of the quaternions")
    decay: float = Field(1.0, gt=0, le=1, description="factor on all rates but that of the means, again and again")
    decay_interval: int = Field(400, ge=1, description="steps between two of these factors")

    def of_step(self, step: float, extent: float) -> dict[str, float]:
        """Return the rate per parameter group; `step` counts from the start of the decay. Means: world units."""
        factor = self.decay ** (int(step + 1e-9) // self.decay_interval)
        means = exponential_lr(
            self.position_offset + step,
            init=self.position_init, final=self.position_final, max_steps=self.max_steps,
        )  # fmt: skip
        others = {
            "sh_dc": self.sh_dc, "sh_rest": self.sh_rest, "opacity_logits": self.opacity,
            "log_scales": self.scales, "quats": self.quats,
        }  # fmt: skip
        return {"means": means * extent, **{name: rate * factor for name, rate in others.items()}}


class UpdateRates:
    """Schedule task: set the learning rate of each optimizer group named in `rates`.

    starts      steps at which the decays begin anew (a method of several rounds), ascending, the first 1
    scale       of the plan: steps of the full run are 1 / scale of this run's
    """

    def __init__(self, rates: FineTuningRates, *, starts: Sequence[int] = (1,), scale: float = 1.0) -> None:
        self.rates, self.starts, self.scale = rates, tuple(starts), scale

    def __call__(self, optimizer: SplatOptimizer, scene: Scene, step: int) -> None:
        start = max((s for s in self.starts if s <= step), default=1)
        for name, rate in self.rates.of_step((step - start + 1) / self.scale, scene.extent).items():
            if name in optimizer.groups:
                optimizer.set_lr(name, rate)


def windows_before(removals: Iterable[int], length: int) -> list[range]:
    """Return per removal (steps, ascending) the range of `length` steps before it, over which gradients are averaged.

    No window starts before the previous removal. A removal right after another one uses the gradients of its own step,
    which are collected first.
    """
    steps = list(removals)
    return [range(max(last + 1, at - length), max(at, last + 2)) for last, at in zip([0, *steps], steps, strict=False)]


def collect_anew(scheduler: Scheduler, windows: Sequence[range]) -> None:
    """Register post tasks that accumulate gradient statistics over each of the `windows`, starting from zero."""
    starts = [window.start for window in windows]
    scheduler.register_task(starts, clear_statistics, priority=CLEAR, name="clear gradient statistics")
    steps = [step for window in windows for step in window]
    scheduler.register_task(steps, collect_statistics, name="collect gradient statistics")


class FineTuningStage(Stage):
    """Fine-tunes trained Gaussians: all SH bands active, new Adam state, L1 + SSIM, no densification.

    A method subclasses it, says in `starts_from` whose trained scene that is, and registers in `register_post_task`
    what removes Gaussians.

    rates           step sizes
    lambda_dssim    weight of 1 - SSIM in the loss
    rates_plan      when the step sizes are set, in steps of the full run; a longer stage sets them to its end
    statistics      render with what screen-space gradient statistics need
    """

    rates_plan: range = range(30_000)
    statistics: bool = False

    def __init__(self, opt: OptimizationParams, rates: FineTuningRates, *, lambda_dssim: float = 0.2) -> None:
        super().__init__(opt)
        self.rates, self.lambda_dssim = rates, lambda_dssim
        self._options: RasterOptions | None = None  # of the last step: nearly always those of the next

    def begin(self, context: StageContext) -> SplatModel:
        model = context.model
        if isinstance(model, GaussianModel):
            model.active_sh_degree = model.max_sh_degree
            for name in ("grad_accum", "denom", "max_radii2d"):
                getattr(model, name).zero_()
        return model

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        rates = self.rates.of_step(0, scene.extent)
        return SplatOptimizer(model, [ParamGroup(name, lr) for name, lr in rates.items()])

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        update = UpdateRates(self.rates, starts=self.round_starts(), scale=self.opt.schedule_scale)
        plan = self.when(self.rates_plan)
        assert isinstance(plan, range)
        lasting = range(plan.start, max(plan.stop, self.iterations), plan.step)
        scheduler.register_task(lasting, update, name="update lr")

    def round_starts(self) -> Sequence[int]:
        """Steps of this run at which the learning-rate decay restarts."""
        return (1,)

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        if self._options is None or self._options.background is not background:
            self._options = RasterOptions(background=background, grad2d=self.statistics)
        return self._options

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        truth = view.image(background, result.image.device)
        return photometric_loss(result.image, truth, lambda_dssim=self.lambda_dssim)
