"""Training stages of anchor models: `AnchorStage` (Scaffold-GS), `CodedAnchorStage` (with masks and a rate).

Source: Scaffold-GS (arXiv 2312.00109) as trained by HAC (arXiv 2403.14530); the plan is that of the Splatwizard paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.learning_rate import exponential_lr
from sw_gaussians.pictures import PictureSizes, Rounds

from splatwizard_core.api import (
    LossPack,
    ParamGroup,
    RasterOptions,
    RenderResult,
    SplatOptimizer,
    Stage,
    StageContext,
    TaskLog,
    photometric_loss,
)
from splatwizard_native import fast_enabled
from sw_anchors.anchors import AnchorModel
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.fast import loss as fast_loss
from sw_anchors.fast import replay
from sw_anchors.fast.whole_step import Weighted, WholeAnchorStep, all_weighted
from sw_anchors.growth import accumulate_anchor_statistics, adjust_anchors
from sw_anchors.params import AnchorParams, CodedAnchorParams

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import (
        CameraSampler,
        OptimizationParams,
        PipelineParams,
        Scene,
        Scheduler,
        SplatModel,
        View,
    )


class AnchorStage(Stage):
    """Trains an AnchorModel: photometric loss, volume regulariser, growing and pruning of anchors.

    A method overrides `learning_rates` (its own networks), the two register methods (its own tasks) and `extra_loss`.
    """

    name = "anchors"
    opt: AnchorParams
    trains: type[AnchorModel] = AnchorModel

    def __init__(self, opt: AnchorParams, *, pictures: PictureSizes | None = None) -> None:
        """Set up for `opt`; pictures: `opt.pictures.load(plugins)`, None where their sizes do not change."""
        super().__init__(opt)
        opt.pictures.check(opt, pictures)
        self.pictures, self._whole = pictures, WholeAnchorStep()
        self.extent, self.early = 1.0, opt.lr.mlp_opacity_early or 1.0  # of the scene, once the stage begins

    def at(self, step: int) -> int:
        """Scale a step, or a step count, of the full schedule to this run, as `when` does."""
        found = self.when(step)
        assert isinstance(found, int)
        return found

    def begin(self, context: StageContext) -> SplatModel:
        model = context.model
        if not isinstance(model, self.trains):
            raise TypeError(f"stage '{self.name}' trains a {self.trains.__name__}, not a {type(model).__name__}")
        self.growth_draws = context.generator("growth")
        self.extent, points = context.scene.extent, context.scene.points
        if points is not None and len(points.xyz) < 50_000:  # at 1 none of the anchors of chair's 10,000 was left
            self.early = self.opt.lr.mlp_opacity_early or 0.3
        if self.opt.visible_offsets:
            model.show_offsets(self.opt.visible_offsets, torch.stack([v.camera.center for v in context.scene.train]))
        return model

    # Optimizer

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        inner, growth = super().create_sampler(scene, generator), self.opt.growth
        rounds = Rounds([step for steps in self.adjustments for step in steps], growth.stop, growth.interval)
        return self.opt.pictures.sampler(self.pictures, inner, scene, self, rounds)

    def decay(self, step: int, init: float, final: float, *, max_steps: int | None = None) -> float:
        """Decay exponentially from `init` at step 0 to `final` at `max_steps` of the full run (None: lr.max_steps)."""
        last = self.opt.lr.max_steps if max_steps is None else max_steps
        return exponential_lr(step, init=init, final=final, max_steps=self.at(last))

    def learning_rates(self, step: int) -> Mapping[str, float]:
        """Return the learning rate per parameter or submodule, by name; the names are the optimizer's groups."""
        lr = self.opt.lr
        # An anchor whose opacities are all negative is never drawn again. All anchors of a random start have equal
        # features and most of them lie in empty space: at its full rate the network turns down all of them together.
        early = self.early if step <= self.at(lr.early_until) else 1.0
        return {
            "offsets": self.decay(step, lr.offsets_init, lr.offsets_final) * self.extent,
            "features": lr.features,
            "log_scales": lr.scales,
            "mlp_opacity": self.decay(step, lr.mlp_opacity_init, lr.mlp_opacity_final) * early,
            "mlp_cov": self.decay(step, lr.mlp_cov_init, lr.mlp_cov_final),
            "mlp_color": self.decay(step, lr.mlp_color_init, lr.mlp_color_final),
        }

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        # Anchors themselves are in no group: their published rate is 0.
        return SplatOptimizer(model, [ParamGroup(name, lr) for name, lr in self.learning_rates(0).items()])

    # Plan

    @property
    def adjustments(self) -> list[range]:
        """Return the steps of this run that grow and prune anchors, before and after the pause."""
        growth = self.opt.growth
        pause_end = max(growth.start, growth.pause_start, growth.pause_end)
        found = []
        for start, stop in ((growth.start, min(growth.pause_start, growth.stop)), (pause_end, growth.stop)):
            if start < stop:
                steps = self.when(range(start, stop, growth.interval))
                assert isinstance(steps, range)
                found.append(steps)
        return found

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        scheduler.register_task(self.when(range(self.opt.lr.max_steps)), self.update_lr)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        scheduler.register_task(self.when(range(self.opt.growth.stop)), self.collect_gradient_statistics)
        for steps in self.adjustments:
            scheduler.register_task(steps, self.adjust_anchor)

    def update_lr(self, optimizer: SplatOptimizer, step: int) -> None:
        """Set the learning rates of this step."""
        for name, lr in self.learning_rates(step).items():
            optimizer.set_lr(name, lr)

    def collect_gradient_statistics(self, model: AnchorModel, result: RenderResult, step: int) -> None:
        """Add this view to the statistics for growing and pruning."""
        if step > self.at(self.opt.growth.start_stat):
            assert result.grad2d is not None
            accumulate_anchor_statistics(model, result.extras["anchors"], result.grad2d.value, result.radii)

    def adjust_anchor(
        self, model: AnchorModel, optimizer: SplatOptimizer, step: int, log: TaskLog | None = None
    ) -> None:
        """Grow and prune anchors; curves "grown" and "pruned"."""
        growth = self.opt.growth
        report = adjust_anchors(
            model, optimizer, step=step, generator=self.growth_draws, interval=self.at(growth.interval),
            success=growth.success, grad_threshold=growth.grad_threshold, min_opacity=growth.min_opacity,
            levels=growth.levels, init_factor=growth.init_factor, hierarchy=growth.hierarchy, subvoxel=growth.subvoxel,
        )  # fmt: skip
        if log is not None:
            log.scalar("grown", report.grown)
            log.scalar("pruned", report.pruned)

    # Loss

    def random_background(self, step: int) -> bool:
        return step <= self.at(self.opt.random_background_until)

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        return RasterOptions(background=background, grad2d=True)

    def extra_loss(self, model: Any, result: RenderResult, step: int) -> Mapping[str, Weighted | Tensor]:
        """Return further loss terms by name: a scalar, or (weight, scalar), which needs fewer GPU launches."""
        return {}

    def counted(self, result: RenderResult) -> int | Tensor:
        """Return of how many Gaussians the mean volume is, at least 1; a scalar if a tensor."""
        return max(len(result.inputs.means), 1)

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        truth, terms = view.image(background, result.image.device), self.terms(model, result, step)
        found = photometric_loss(result.image, truth, lambda_dssim=self.opt.loss.lambda_dssim)
        total, *weighted = (fast_loss.weighted_sum if fast_enabled() else weighted_sum)(found.total, *terms.values())
        return LossPack(total, found.parts | dict(zip(terms, weighted, strict=True)))

    def terms(self, model: Any, result: RenderResult, step: int) -> dict[str, Weighted]:
        """Return the terms beside the photometric loss: the mean volume (product of scales), and the extra ones."""
        assert result.inputs.scales is not None
        mean = fast_loss.mean_product if fast_enabled() else mean_product
        volume = self.opt.loss.volume, mean(result.inputs.scales, self.counted(result))
        return {"volume": volume, **all_weighted(self.extra_loss(model, result, step))}

    def whole_step(self, state: Any, view: View, camera: Any, background: Tensor) -> Any:
        return self._whole.of(self, state, view, camera, background) if type(self).loss is AnchorStage.loss else None


def mean_product(scales: Tensor, count: int | Tensor) -> Tensor:
    """Return the sum over rows of the product of scales [M,3], over a count; a scalar, differentiable."""
    return scales.prod(dim=1).sum() / count


def weighted_sum(start: Tensor, *terms: Weighted) -> tuple[Tensor, ...]:
    """Return (start + sum of weight times term, the weighted terms without gradient), all scalars."""
    weighted = [weight * term for weight, term in terms]
    return start + sum(weighted), *(each.detach() for each in weighted)


class CodedAnchorStage(AnchorStage):
    """Trains a CodedAnchors: adds mask learning, and fits the position lattice at step 1.

    A method adds the switches of phase (`PhaseSwitch(step, QUANTIZED)`, ...), its context model and the rate term.
    """

    opt: CodedAnchorParams
    trains = CodedAnchors
    leading: Any = None  # task `lead-to-size` of a training to a size, by whose `factor` bits cost more

    def begin(self, context: StageContext) -> SplatModel:
        model = super().begin(context)
        assert isinstance(model, CodedAnchors)
        model.noise = context.generator("noise")
        return model

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        replay.release(model)
        return super().finish(model, scene)

    def learning_rates(self, step: int) -> Mapping[str, float]:
        rates = super().learning_rates(step)
        return {"offsets": rates["offsets"], "mask_logits": self.mask_rate(step) * self.extent, **rates}

    def mask_rate(self, step: int) -> float:
        """Return the learning rate of the mask logits per scene extent."""
        return self.decay(step, self.opt.lr.masks_init, self.opt.lr.masks_final)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_pre_task(scheduler, ppl, opt)
        scheduler.register_task(1, self.update_anchor_bound)

    def update_anchor_bound(self, model: CodedAnchors) -> None:
        """Fit the position lattice to the current anchors."""
        model.update_bounds()
