"""The training stage: codebooks at its first step, then fine-tuning through the quantizers of the file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sw_gaussians.finetune.fine_tuning import FineTuningStage

from splatwizard_core.api import CameraIterator, GaussianModel, SceneError
from sw_c3dgs.compression import Compress
from sw_c3dgs.model import SharedGaussians

if TYPE_CHECKING:
    from splatwizard_core.api import OptimizationParams, PipelineParams, Scene, Scheduler, SplatModel, StageContext
    from sw_c3dgs.config import C3DGSConfig


class FineTuneStage(FineTuningStage):
    """Goes on from a trained 3DGS scene whose Gaussians share colours and shapes from the first step on."""

    name = "finetune"
    starts_from = "3dgs"
    rates_plan = range(5_000)

    def __init__(self, config: C3DGSConfig) -> None:
        super().__init__(config, config.lr, lambda_dssim=config.lambda_dssim)
        self.config = config
        self.compress = Compress(config, seed=0)

    def begin(self, context: StageContext) -> SplatModel:
        if not isinstance(context.model, GaussianModel):
            raise SceneError("c3dgs starts from explicit Gaussians; those of the given scene depend on the camera")
        self.compress.seed = context.generator("method").initial_seed()
        self._rasterizer = context.rasterizer
        return SharedGaussians.of(context.model)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        # The optimizer has no moments at the first step: it finds the new parameters by name.
        scheduler.register_task(1, self.compress, name="VQ compress")
        super().register_pre_task(scheduler, ppl, opt)

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        """Return the model, with codebooks also where there was no step to make them at."""
        if isinstance(model, SharedGaussians):
            self.compress(model, CameraIterator(scene.train), self._rasterizer, 0)
        return model
