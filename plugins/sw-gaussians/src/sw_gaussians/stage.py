"""The training stage of 3DGS, which other methods extend or wrap."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

from splatwizard_core.api import (
    ConfigError,
    DensityControl,
    GaussianModel,
    LossPack,
    ParamGroup,
    RasterOptions,
    Scene,
    SplatOptimizer,
    Stage,
    StageContext,
    photometric_loss,
)
from sw_gaussians.adam_moments import keep_moments
from sw_gaussians.averaging import average_of_the_end
from sw_gaussians.control_tasks import control_task
from sw_gaussians.fast.fused_adam import FusingOptimizer, offer_updates
from sw_gaussians.fast.whole_step import Terms, WholeStep
from sw_gaussians.late_batches import LAST_PRIORITY, SumViews
from sw_gaussians.learning_rate import exponential_lr
from sw_gaussians.pictures import PictureSizes, Rounds
from sw_gaussians.sparse_adam import SparseSplatOptimizer

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    import torch
    from torch import Tensor

    from splatwizard_core.api import (
        Camera,
        CameraSampler,
        OptimizationParams,
        PipelineParams,
        RenderResult,
        Scheduler,
        SplatModel,
        TrainingState,
        View,
    )
    from splatwizard_core.training.density import DensityReport, DensityTask
    from sw_gaussians.config import GaussianTraining


class UpdateLearningRate:
    """Sets the step size of the means: exponential decay, times the scene extent."""

    def __init__(
        self,
        *,
        init: float = 1.6e-4,
        final: float = 1.6e-6,
        max_steps: int = 30_000,
        delay_steps: int = 0,
        delay_mult: float = 0.01,
    ) -> None:
        self.init, self.final, self.max_steps = init, final, max_steps
        self.delay_steps, self.delay_mult = delay_steps, delay_mult

    def rate(self, step: int, extent: float) -> float:
        """Return the learning rate of the means at `step`, world units."""
        return extent * exponential_lr(
            step,
            init=self.init,
            final=self.final,
            max_steps=self.max_steps,
            delay_steps=self.delay_steps,
            delay_mult=self.delay_mult,
        )

    def __call__(self, optimizer: SplatOptimizer, scene: Scene, step: int) -> None:
        optimizer.set_lr("means", self.rate(step, scene.extent))


def increase_sh_degree(model: GaussianModel) -> None:
    """Activate one more SH band, up to the model's maximum degree."""
    model.active_sh_degree = min(model.active_sh_degree + 1, model.max_sh_degree)


class ThreeDGSStage(Stage):
    """Adam on six parameter groups, L1 + SSIM, and a density control.

    control         what adds and removes Gaussians: `config.density.load(plugins)`; None: adaptive density control
    pictures        what changes sizes of pictures: `config.pictures.load(plugins)`; None: nothing
    fuses_updates   on CUDA spherical harmonics are updated in the backward pass, at steps at which nothing else asks
                    for their gradients; with dense Adam alone. None: from `fused_adam.MIN_FUSED_GAUSSIANS` Gaussians on
    """

    name = "3dgs"

    def __init__(
        self,
        opt: GaussianTraining,
        control: DensityControl | None = None,
        *,
        pictures: PictureSizes | None = None,
        fuses_updates: bool | None = False,
    ) -> None:
        super().__init__(opt)
        self.config = opt
        self.control = opt.density.usual() if control is None else control
        self.control.when = self.when
        self.fuses_updates = fuses_updates
        opt.pictures.check(opt, pictures)
        self.pictures = pictures
        if opt.sparse_adam:
            for key, is_on in (
                ("fused_updates=true", fuses_updates),
                ("fast.late_views", opt.fast.late_views > 1),
                (f"density={opt.density.name}", self.control.regularises),
            ):
                if is_on:
                    raise ConfigError(
                        f"sparse_adam=true leaves Gaussians that no view shows as they are, and {key} needs updates of "
                        "all: set one of the two",
                        key="sparse_adam",
                    )
        end = opt.FULL_ITERATIONS if opt.scale_schedule else opt.iterations
        if opt.fast.late_views > 1 and self.control.until >= end:
            raise ConfigError(
                f"fast.late_views would have no effect: density control goes on until step {self.control.until}, and "
                f"the plan ends at {end}; leave it off, or set scale_schedule=true, more iterations or a lower "
                "density.settings.stop"
            )
        self._options: RasterOptions | None = None  # of the last step: nearly always those of the next
        self._needs: frozenset[str] = frozenset()  # of these options
        self._optimizer: SplatOptimizer | None = None
        self._post: Scheduler | None = None
        self._whole = WholeStep()

    def steps(self, steps: int) -> int:
        """Scale a step count of the full schedule to this, possibly shortened, run."""
        found = self.when(steps)
        assert isinstance(found, int)
        return found

    @property
    def densifications(self) -> range:
        """Steps of this run that densify."""
        found = self.when(self.control.rounds)
        assert isinstance(found, range)
        return found

    @functools.cached_property
    def settled(self) -> int:
        """Last step of this run with density control."""
        return self.steps(self.control.until)

    def begin(self, context: StageContext) -> SplatModel:
        model = context.model
        if self.fuses_updates and not next(model.parameters()).is_cuda:
            raise ConfigError("fused_updates is for rasterizers on CUDA, and the model is on the CPU: leave it off")
        if hasattr(model, "split_seed"):
            model.split_seed = context.generator("split").initial_seed()
        self.control.begin(context)
        return model

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        inner = super().create_sampler(scene, generator)
        rounds = Rounds(self.densifications, self.control.until, self.control.rounds.step)
        return self.config.pictures.sampler(self.pictures, inner, scene, self, rounds)

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        lr = self.config.lr
        rates: Mapping[str, float] = {
            "means": lr.position_init * scene.extent, "sh_dc": lr.sh_dc, "sh_rest": lr.sh_rest,
            "opacity_logits": lr.opacity, "log_scales": lr.scales, "quats": lr.quats,
        }  # fmt: skip
        dense = SplatOptimizer if self.fuses_updates is False else FusingOptimizer
        adam = SparseSplatOptimizer if self.config.sparse_adam else dense
        betas = 0.9, lr.beta2
        self._optimizer = adam(model, [ParamGroup(name, lr=rate, betas=betas) for name, rate in rates.items()])
        return self._optimizer

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        """Return the model, with Adam's moments attached for a following stage."""
        if self._optimizer is not None and self._optimizer.model is model:
            keep_moments(model, self._optimizer)
        self._optimizer = None
        self.control.finish(model)
        return model

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        lr, last = self.config.lr, self.iterations
        # In a run shorter than lr.max_steps "every step" is written as "update lr" is: checkpoints keep their plan.
        self._register(scheduler, self.control.pre_tasks(), every=range(max(last, self.steps(lr.max_steps))))
        update_lr = UpdateLearningRate(
            init=lr.position_init,
            final=lr.position_final,
            max_steps=self.steps(lr.max_steps),
            delay_steps=self.steps(lr.position_delay_steps),
            delay_mult=lr.position_delay_mult,
        )
        scheduler.register_task(self.when(range(lr.max_steps)), update_lr, name="update lr")
        degrees = self.when(range(0, lr.max_steps, self.config.sh_interval))
        scheduler.register_task(degrees, increase_sh_degree, name="increase SH degree")
        average = average_of_the_end(self.config.fast.average, first=self.settled, last=last)
        if average is not None:
            scheduler.register_task(average.steps, average, name="average parameters")

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        self._post = scheduler
        self._register(scheduler, self.control.post_tasks(), every=range(self.iterations + 1))
        if self.config.fast.late_views > 1:
            sums = SumViews(views=self.config.fast.late_views, first=self.settled, last=self.iterations - 1)
            steps = range(self.settled, self.iterations + 1)
            scheduler.register_task(steps, sums, priority=LAST_PRIORITY, name="sum views")

    def _register(self, scheduler: Scheduler, tasks: Iterable[DensityTask], *, every: range) -> None:
        for name, when, do in tasks:
            task = control_task(do, self.control, self.adjust)
            scheduler.register_task(every if when is None else self.when(when), task, name=name)

    def adjust(self, state: TrainingState) -> DensityReport:
        """Let the density control add and remove Gaussians; subclasses may add rules."""
        return self.control.adjust(state)

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        # A stage made of this one may draw twice, or read gradients in its loss.
        if self.fuses_updates is not False and type(self) is ThreeDGSStage:
            offer_updates(self._optimizer, self._post, step, before=self.iterations, forced=bool(self.fuses_updates))
        needs = self.control.needs(step)
        if step >= self.iterations:  # the last step asks for all that any step asks for
            needs |= self.control.needs(1)
        if self._options is None or self._options.background is not background or self._needs != needs:
            asked: dict[str, Any] = dict.fromkeys(sorted(needs), True)
            self._options = RasterOptions(background=background, **asked)
            self._needs = needs
        return self._options

    def whole_step(
        self, state: TrainingState, view: View, camera: Camera, background: Tensor
    ) -> tuple[RenderResult, LossPack] | None:
        if type(self) is not ThreeDGSStage or type(self.control).regularised is not DensityControl.regularised:
            return None
        return self.step_in_one(state, view, camera, background)

    def step_in_one(
        self, state: TrainingState, view: View, camera: Camera, background: Tensor, terms: Terms | None = None
    ) -> tuple[RenderResult, LossPack] | None:
        """Do what `whole_step` says, with these further terms of the maps; without those of the density control."""
        options = functools.partial(self.raster_options, state.step, background)
        return self._whole(options, self.config.loss, state, view, camera, background, terms)

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        truth, settings = view.image(background, result.image.device), self.config.loss
        loss = photometric_loss(result.image, truth, lambda_dssim=settings.lambda_dssim, padding=settings.ssim_padding)
        return self.control.regularised(loss, result, step)
