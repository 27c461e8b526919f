"""The training stage of 3DGS: the one that other methods start from, extend, or take over whole."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch

from splatwizard_core.api import (
    ConfigError,
    LossPack,
    ParamGroup,
    RasterOptions,
    SplatOptimizer,
    Stage,
    StageContext,
    photometric_loss,
)
from sw_gaussians import fast_tasks, fragments, tasks
from sw_gaussians import mcmc_tasks as mcmc
from sw_gaussians.averaging import AverageParameters
from sw_gaussians.cadence import CadencedOptimizer, SparseCadencedOptimizer
from sw_gaussians.config import FUSED_FROM, GaussianTraining
from sw_gaussians.fused_adam import FusingOptimizer
from sw_gaussians.late_batches import BatchingOptimizer, SumViews
from sw_gaussians.moments import keep_moments
from sw_gaussians.resolution import ResolutionSampler, by_resolution
from sw_gaussians.settling import SettleLearningRates
from sw_gaussians.sparse_adam import SparseSplatOptimizer
from sw_gaussians.statistics import collect_statistics

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
        View,
    )


READERS = (collect_statistics, fragments.collect_opacity_gradients)
"""Tasks that leave all gradients alone, and read none of spherical harmonics."""

AVERAGE_EVERY = 10
"""Steps between two samples of `fast.average`, fewer if it begins later: reading them takes a hundredth of a step."""


class ThreeDGSStage(Stage):
    """Adam on six parameter groups, L1 + SSIM, adaptive density control until half time.

    fuses_updates   on CUDA spherical harmonics are updated in the backward pass, at steps at which nothing else asks
                    for their gradients; with dense Adam alone. None: from `FUSED_FROM` Gaussians on, if all of that
                    holds
    """

    name = "3dgs"

    def __init__(self, opt: GaussianTraining, *, fuses_updates: bool | None = False) -> None:
        super().__init__(opt)
        self.config = opt
        self.fuses_updates = fuses_updates
        if fuses_updates and (opt.sparse_adam != "off" or opt.fast.sh_every > 1):
            raise ConfigError(
                "fused_updates updates all Gaussians at every step: leave sparse_adam off and fast.sh_every at 1"
            )
        if opt.fast.late_views > 1 and (fuses_updates or opt.sparse_adam != "off" or opt.fast.sh_every > 1):
            raise ConfigError(
                "fast.late_views sums the gradients of all Gaussians: leave fused_updates and sparse_adam off, and "
                "fast.sh_every at 1"
            )
        if opt.sparse_adam != "off" and opt.mcmc.enabled:
            raise ConfigError(
                "sparse_adam leaves hidden Gaussians as they are, which the regularisers of mcmc.enabled must reach: "
                "set one of the two"
            )
        budget = opt.fast.densify == "budget"
        if budget and opt.mcmc.enabled:
            raise ConfigError("mcmc.enabled and fast.densify=budget are two density controls: set one of them")
        halves = opt.fast.opacity == "halve"
        if opt.mcmc.enabled and (halves or opt.fast.morton):
            raise ConfigError(
                "mcmc.enabled neither resets opacities nor sorts Gaussians: fast.opacity=halve and fast.morton would "
                "have no effect, leave them off"
            )
        if halves and opt.sparse_adam == "none":
            raise ConfigError(
                "fast.opacity=halve clears Adam's moments, after which sparse_adam=none makes steps of 3.2 times the "
                "learning rate: set sparse_adam=per_row or off"
            )
        if opt.fast.veto_views and not budget:
            raise ConfigError("fast.veto_views is a veto of the budget's draw: set fast.densify=budget with it")
        if opt.fast.late_prune and opt.mcmc.enabled:
            raise ConfigError("mcmc.enabled moves Gaussians instead of pruning them: leave fast.late_prune off")
        late, key = opt.fast.late(), "mcmc.stop" if opt.mcmc.enabled else "densify.stop"
        stop = opt.mcmc.stop if opt.mcmc.enabled else opt.densify.stop
        end = opt.FULL_ITERATIONS if opt.scale_schedule else opt.iterations
        if late and stop >= end:
            raise ConfigError(
                f"{' and '.join(late)} would have no effect: density control goes on until {key}={stop}, and the plan "
                f"ends at {end}; leave it off, or set scale_schedule=true, more iterations or a lower {key}"
            )
        self._fragments = budget and opt.fast.score == "opacity_variance"
        if self._fragments and opt.densify.absgrad:
            raise ConfigError("densify.absgrad does not go with fast.score=opacity_variance: set fast.score=gradient")
        self._options: RasterOptions | None = None  # of the last step: nearly always those of the next
        if opt.fast.resolution_hold and opt.fast.resolution == "none":
            raise ConfigError(
                "fast.resolution_hold goes by the sizes of the pictures: set fast.resolution=dash with it"
            )
        self._pictures: ResolutionSampler | None = None
        self._optimizer: SplatOptimizer | None = None
        self._post: Scheduler | None = None
        self.white = False  # known when the stage begins; a plan can be printed without a scene

    def steps(self, steps: int) -> int:
        """Return a number of steps of the full run in steps of this one, for what a task counts itself."""
        found = self.when(steps)
        assert isinstance(found, int)
        return found

    @property
    def densifications(self) -> range:
        """Steps of this run that densify."""
        densify = self.config.densify
        found = self.when(range(densify.start, densify.stop, densify.interval))
        assert isinstance(found, range)
        return found

    @functools.cached_property  # the rasterizer's options ask for it at each step
    def settled(self) -> int:
        """Step of this run at which density control ends."""
        chain = self.config.mcmc
        return self.steps(chain.stop if chain.enabled else self.config.densify.stop)

    @property
    def late_prunes(self) -> range:
        """Steps of this run at which `fast.late_prune` prunes: one, two and three fifths into what is left then.

        In the full plan these are 18,000, 21,000 and 24,000. Source: FastGS (arXiv 2511.04283), which prunes at 27,000
        too.
        """
        fifth = max(1, (self.iterations - self.settled) // 5)
        return range(self.settled + fifth, self.settled + 4 * fifth, fifth)

    def begin(self, context: StageContext) -> SplatModel:
        self.white = context.scene.protocol.background == "white"
        model = context.model
        if self.fuses_updates and not next(model.parameters()).is_cuda:
            raise ConfigError("fused_updates is for rasterizers on CUDA, and the model is on the CPU: leave it off")
        if hasattr(model, "split_seed"):
            model.split_seed = context.generator("split").initial_seed()
        if self._fragments:
            fragments.add_buffer(model)
        return model

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        sampler, fast = super().create_sampler(scene, generator), self.config.fast
        if fast.resolution == "none":
            return sampler
        self._pictures = by_resolution(
            sampler,
            scene,
            full_at=self.steps(self.config.densify.stop),
            rounds=self.densifications,
            most=fast.resolution_start,
            rounding=fast.resolution_rounding,
        )
        return self._pictures

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        groups = [
            ParamGroup("means", lr=self.config.lr.position_init * scene.extent),
            *(ParamGroup(name, lr=rate) for name, rate in self._rates().items()),
        ]
        sparse, every = self.config.sparse_adam, self.config.fast.sh_every
        if self.config.fast.late_views > 1:
            self._optimizer = BatchingOptimizer(model, groups)
        elif sparse == "off":
            self._optimizer = (
                CadencedOptimizer(model, groups, every=every) if every > 1 else FusingOptimizer(model, groups)
            )
        elif every > 1:
            self._optimizer = SparseCadencedOptimizer(model, groups, every=every, bias_correction=sparse)
        else:
            self._optimizer = SparseSplatOptimizer(model, groups, bias_correction=sparse)
        return self._optimizer

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        """Return the model, with Adam's moments beside it for whoever goes on from here."""
        if self._optimizer is not None and self._optimizer.model is model:
            keep_moments(model, self._optimizer)
        self._optimizer = None
        if self._fragments:
            fragments.drop_buffer(model)
        return model

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        lr, chain = self.config.lr, self.config.mcmc
        if chain.enabled and chain.noise > 0:
            noise = mcmc.AddNoise(strength=chain.noise, min_opacity=chain.min_opacity)
            # First of all: it belongs to the update of the step before, and to that step's learning rate.
            # In a run shorter than lr.max_steps it is written as "update lr" is, so that checkpoints keep their plan.
            steps = range(max(self.iterations, self.steps(lr.max_steps)))
            scheduler.register_task(steps, noise, name="add noise")
        update_lr = tasks.UpdateLearningRate(
            init=lr.position_init,
            final=lr.position_final,
            max_steps=self.steps(lr.max_steps),
            delay_steps=self.steps(lr.position_delay_steps),
            delay_mult=lr.position_delay_mult,
            held=self._coarse_until if self.config.fast.resolution_hold else None,
        )
        scheduler.register_task(self.when(range(lr.max_steps)), update_lr, name="update lr")
        scheduler.register_task(
            self.when(range(0, lr.max_steps, self.config.sh_interval)),
            tasks.increase_sh_degree,
            name="increase SH degree",
        )
        self._register_end(scheduler)

    def _register_end(self, scheduler: Scheduler) -> None:
        """Register what is different once the number of Gaussians is settled."""
        fast, first = self.config.fast, self.settled
        end = range(first, self.iterations + 1)
        if fast.late_views > 1:
            sums = SumViews(views=fast.late_views, first=first, last=self.iterations - 1)
            scheduler.register_task(end, sums, name="sum views")
        begin = max(first, round(self.iterations * (1 - fast.average)))
        if fast.late_prune:  # half a round later, when the others have filled in for what the last one took
            begin = max(begin, self.late_prunes[-1] + max(1, self.late_prunes.step // 2))
        if begin < self.iterations:
            every = min(AVERAGE_EVERY, self.iterations - begin)
            begin += (self.iterations - begin) % every
            average = AverageParameters(first=begin, last=self.iterations, every=every)
            scheduler.register_task(average.steps, average, name="average parameters")
        if fast.settle < 1 and first < self.iterations:
            settle = SettleLearningRates(self._rates(), first=first, last=self.iterations, factor=fast.settle)
            scheduler.register_task(end, settle, name="settle learning rates")

    def _rates(self) -> dict[str, float]:
        """Learning rates of the parameters whose rate no task changes but that which lets them settle."""
        lr = self.config.lr
        return {
            "sh_dc": lr.sh_dc, "sh_rest": lr.sh_rest, "opacity_logits": lr.opacity, "log_scales": lr.scales,
            "quats": lr.quats,
        }  # fmt: skip

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        self._post = scheduler
        if self.config.mcmc.enabled:
            self._register_mcmc(scheduler)
            return
        densify = self.config.densify
        scheduler.register_task(
            self.when(range(densify.stop)),
            collect_statistics,
            name="collect gradient statistics",
        )
        if self._fragments:
            scheduler.register_task(
                self.when(range(densify.stop)), fragments.collect_opacity_gradients, name="collect opacity gradients"
            )
        if self.config.fast.densify == "budget":
            scheduler.register_task(self.densifications, self._densify_to_budget(), name="densify to budget")
        else:
            scheduler.register_task(self.densifications, self.densification(), name="prune and densify")
        if self.config.fast.late_prune:
            settings = self.config.loss
            prune = fast_tasks.PruneByViews(lambda_dssim=settings.lambda_dssim, padding=settings.ssim_padding)
            scheduler.register_task(self.late_prunes, prune, name="prune by views")
        if self.config.fast.opacity == "halve":
            halve = self.when(range(0, densify.stop, densify.reset_interval))
            scheduler.register_task(halve, fast_tasks.HalveOpacity(), name="halve opacity")
            return
        reset_opacity = tasks.ResetOpacity(ceiling=densify.reset_opacity)
        if self.white and 0 < densify.white_reset < densify.stop:
            # Against white, faint Gaussians in empty space cost nothing at first and hide the object later.
            scheduler.register_task(
                self.when(densify.white_reset), reset_opacity, name="reset opacity (white background)"
            )
        scheduler.register_task(
            self.when(range(0, densify.stop, densify.reset_interval)), reset_opacity, name="reset opacity"
        )

    def _coarse_until(self) -> int:
        return self._pictures.plan.coarse_until if self._pictures is not None else 0

    def min_opacity(self) -> float:
        """Return the opacity below which density control prunes; a stage with a rule of its own overrides it."""
        return self.config.densify.min_opacity

    def densification(self) -> Callable[..., None]:
        """Return the task that clones, splits and prunes; a stage with rules of its own wraps it."""
        densify = self.config.densify
        return tasks.PruneAndDensify(
            grad_threshold=densify.grad_threshold,
            percent_dense=densify.percent_dense,
            min_opacity=self.min_opacity(),
            world_prune=densify.world_prune,
            size_rules_after=self.steps(densify.reset_interval),
            prune_screen_px=densify.prune_screen_px,
            revised_opacity=densify.revised_opacity,
            reset_interval=self.steps(densify.reset_interval),
            pause_after_reset=self.steps(densify.pause_after_reset),
        )

    def _densify_to_budget(self) -> fast_tasks.DensifyToBudget:
        densify, fast = self.config.densify, self.config.fast
        rounds = self.densifications
        return fast_tasks.DensifyToBudget(
            first=rounds.start,
            last=rounds[-1] if rounds else rounds.start,
            interval=rounds.step,
            cap=fast.cap,
            growth=fast.growth,
            score=fast.score,
            grad_threshold=densify.grad_threshold,
            percent_dense=densify.percent_dense,
            min_opacity=self.min_opacity(),
            morton=fast.morton,
            veto_views=fast.veto_views,
            veto_pixels=fast.veto_pixels,
        )

    def _register_mcmc(self, scheduler: Scheduler) -> None:
        chain = self.config.mcmc
        when = self.when(range(chain.start, chain.stop, chain.interval))
        scheduler.register_task(when, mcmc.Relocate(min_opacity=chain.min_opacity), name="relocate")
        grow = mcmc.Grow(cap=chain.cap, growth=chain.growth, min_opacity=chain.min_opacity)
        scheduler.register_task(when, grow, name="grow")

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        if self.fuses_updates is not False:
            self._offer_updates(step)
        # The variance of opacity gradients costs time in the backward pass; the last step asks for all there is.
        fragment = self._fragments and (step < self.settled or step >= self.iterations)
        options = self._options
        if options is None or options.background is not background or options.fragment_grad != fragment:
            statistics, absgrad = not self.config.mcmc.enabled, self.config.densify.absgrad
            self._options = options = RasterOptions(
                background=background,
                grad2d=statistics and not absgrad,
                absgrad=statistics and absgrad,
                fragment_grad=fragment,
            )
        return options

    def _offer_updates(self, step: int) -> None:
        """Offer this step's updates to the backward pass, if no task but the statistics sees gradients."""
        if type(self) is not ThreeDGSStage or not isinstance(self._optimizer, FusingOptimizer) or self._post is None:
            return  # a stage made of this one may draw twice, or read gradients in its loss
        if self.fuses_updates is None and self._optimizer.model.num_rows < FUSED_FROM:
            return
        due = (entry.task for entry in self._post.registrations if entry.due(step))
        if step < self.config.iterations and torch.is_grad_enabled() and all(task in READERS for task in due):
            self._optimizer.offer()

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        truth = view.image(background, result.image.device)
        settings = self.config.loss
        loss = photometric_loss(result.image, truth, lambda_dssim=settings.lambda_dssim, padding=settings.ssim_padding)
        return self._regularised(loss, result) if self.config.mcmc.enabled else loss

    def _regularised(self, loss: LossPack, result: RenderResult) -> LossPack:
        """Add what makes Gaussians fade and shrink unless a picture needs them, so that they can be relocated."""
        chain, inputs = self.config.mcmc, result.inputs
        if inputs.scales is None:
            raise TypeError("mcmc.enabled needs a model with scales: that of 3dgs has them")
        parts = {"opacity": inputs.opacities.mean(), "scale": inputs.scales.mean()}
        total = loss.total + chain.opacity_weight * parts["opacity"] + chain.scale_weight * parts["scale"]
        return LossPack(total, loss.parts | {name: part.detach() for name, part in parts.items()})
