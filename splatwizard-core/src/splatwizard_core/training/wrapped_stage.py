"""A stage around another stage: how a method takes over another one's training and changes a part of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from splatwizard_core.training.stage import CameraSampler, Stage, StageContext

if TYPE_CHECKING:
    from splatwizard_core.gaussians.splat_model import SplatModel
    from splatwizard_core.rendering.rasterizer import RasterOptions, RenderResult
    from splatwizard_core.scene.scene import Scene, View
    from splatwizard_core.training.losses import LossPack
    from splatwizard_core.training.optimizer import SplatOptimizer
    from splatwizard_core.training.params import OptimizationParams, PipelineParams
    from splatwizard_core.training.scheduler import Scheduler


class WrappedStage(Stage):
    """Does everything as the stage inside; a subclass overrides what is its own.

    inner   the stage inside
    opt     hyper-parameters that the tasks of both see; None: those of the stage inside
    """

    def __init__(self, inner: Stage, opt: OptimizationParams | None = None) -> None:
        super().__init__(inner.opt if opt is None else opt)
        self.inner = inner
        self.name = inner.name

    @property
    def iterations(self) -> int:
        return self.inner.iterations

    @property
    def starts_from(self) -> str | None:
        return self.inner.starts_from

    @property
    def taught_by(self) -> tuple[str, ...]:
        return self.inner.taught_by

    @property
    def prefer(self) -> tuple[str, ...]:
        return self.inner.prefer

    def begin(self, context: StageContext) -> SplatModel:
        return self.inner.begin(context)

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        return self.inner.create_optimizer(model, scene)

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        return self.inner.create_sampler(scene, generator)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        self.inner.register_pre_task(scheduler, ppl, opt)

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        self.inner.register_post_task(scheduler, ppl, opt)

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        return self.inner.raster_options(step, background)

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        return self.inner.loss(model, view, result, background, step)

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        return self.inner.finish(model, scene)
