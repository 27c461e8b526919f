"""How methods on anchors train: one stage that they subclass, adding phases, a rate and their own networks.

Source: Scaffold-GS (arXiv 2312.00109) as trained by HAC (arXiv 2403.14530); the plan is that of the Splatwizard paper.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from splatwizard_core.api import (
    LossPack,
    ParamGroup,
    RasterOptions,
    RenderResult,
    SplatOptimizer,
    Stage,
    StageContext,
    When,
    exponential_lr,
    photometric_loss,
)
from splatwizard_core.training.plan import scaled
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.growth import accumulate_anchor_statistics, adjust_anchors
from sw_anchors.params import AnchorParams
from sw_anchors.values import mean_product

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import OptimizationParams, PipelineParams, Scene, Scheduler, SplatModel, View

log = logging.getLogger(__name__)


class AnchorStage(Stage):
    """Trains a CodedAnchors. A method overrides `learning_rates`, the two register methods and `extra_loss`."""

    name = "anchors"

    def __init__(self, opt: AnchorParams) -> None:
        super().__init__(opt)
        self.config = opt
        self.extent = 1.0  # known when the stage begins; a plan can be printed without a scene

    def when(self, when: When) -> When:
        """A plan of the full run, in steps of this one."""
        return scaled(when, self.config.schedule_scale)

    def steps(self, steps: int) -> int:
        """A number of steps likewise, which a task keeps to itself."""
        return max(1, round(steps * self.config.schedule_scale)) if steps > 0 else 0

    def begin(self, context: StageContext) -> SplatModel:
        model = context.model
        if not isinstance(model, CodedAnchors):
            raise TypeError(f"stage '{self.name}' trains anchors, not a {type(model).__name__}")
        model.noise = context.generator("noise")
        self.growth_draws = context.generator("growth")
        self.extent = context.scene.extent
        return model

    # Optimizer

    def decay(self, step: int, init: float, final: float, *, max_steps: int | None = None) -> float:
        """From `init` at step 0 to `final` at `max_steps` of the full run (None: lr.max_steps)."""
        last = self.config.lr.max_steps if max_steps is None else max_steps
        return exponential_lr(step, init=init, final=final, max_steps=self.steps(last))

    def learning_rates(self, step: int) -> Mapping[str, float]:
        """Parameter or submodule -> learning rate; the names are the optimizer's groups and the same at every step."""
        lr = self.config.lr
        return {
            "offsets": self.decay(step, lr.offsets_init, lr.offsets_final) * self.extent,
            "mask_logits": self.decay(step, lr.masks_init, lr.masks_final) * self.extent,
            "features": lr.features,
            "log_scales": lr.scales,
            "mlp_opacity": self.decay(step, lr.mlp_opacity_init, lr.mlp_opacity_final),
            "mlp_cov": self.decay(step, lr.mlp_cov_init, lr.mlp_cov_final),
            "mlp_color": self.decay(step, lr.mlp_color_init, lr.mlp_color_final),
        }

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        # Anchors themselves are in no group: their published rate is 0.
        return SplatOptimizer(model, [ParamGroup(name, lr) for name, lr in self.learning_rates(0).items()])

    # Plan

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        scheduler.register_task(self.when(range(self.config.lr.max_steps)), self.update_lr)
        scheduler.register_task(1, self.update_anchor_bound)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        growth = self.config.growth
        scheduler.register_task(self.when(range(growth.stop)), self.collect_gradient_statistics)
        for start, stop in ((growth.start, growth.pause_start), (growth.pause_end, growth.stop)):
            if start < stop:
                scheduler.register_task(self.when(range(start, stop, growth.interval)), self.adjust_anchor)

    def update_lr(self, optimizer: SplatOptimizer, step: int) -> None:
        for name, lr in self.learning_rates(step).items():
            optimizer.set_lr(name, lr)

    def update_anchor_bound(self, model: CodedAnchors) -> None:
        model.update_bounds()

    def collect_gradient_statistics(self, model: CodedAnchors, result: RenderResult, step: int) -> None:
        if step > self.steps(self.config.growth.start_stat):
            assert result.grad2d is not None
            accumulate_anchor_statistics(model, result.extras["anchors"], result.grad2d.value, result.radii)

    def adjust_anchor(self, model: CodedAnchors, optimizer: SplatOptimizer, step: int) -> None:
        growth = self.config.growth
        report = adjust_anchors(
            model, optimizer, step=step, generator=self.growth_draws, interval=self.steps(growth.interval),
            success=growth.success, grad_threshold=growth.grad_threshold, min_opacity=growth.min_opacity,
            levels=growth.levels, init_factor=growth.init_factor, hierarchy=growth.hierarchy,
        )  # fmt: skip
        log.debug("step %d: %s", step, report)

    # Loss

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        return RasterOptions(background=background, grad2d=True)

    def extra_loss(self, model: Any, result: RenderResult, step: int) -> dict[str, Tensor]:
        """Further terms of the loss, weighted, by name."""
        return {}

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        settings, inputs = self.config.loss, result.inputs
        truth = view.image(background, result.image.device)
        found = photometric_loss(result.image, truth, lambda_dssim=settings.lambda_dssim)
        assert inputs.scales is not None
        terms = {"volume": settings.volume * mean_product(inputs.scales), **self.extra_loss(model, result, step)}
        total = sum(terms.values(), start=found.total)
        return LossPack(total, found.parts | {name: term.detach() for name, term in terms.items()})
