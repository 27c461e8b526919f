"""The training stage: pruning, octree and codebook at the first step, then fine-tuning of what will be decoded."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import torch
from sw_gaussians.finetune.pruning import scores_of, up_to

from splatwizard_core.api import (
    CameraIterator,
    GaussianModel,
    LossPack,
    ParamGroup,
    Pruner,
    Rasterizer,
    Scene,
    SceneError,
    SplatOptimizer,
    Stage,
    TaskLog,
    photometric_loss,
)
from sw_codecs.models.raht_gaussians import RahtGaussians
from sw_mesongs.importance import Importance
from sw_mesongs.published import Published, published

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import (
        OptimizationParams,
        PipelineParams,
        RenderResult,
        Scheduler,
        SplatModel,
        StageContext,
        View,
    )
    from sw_mesongs.config import MesonGSConfig

log = logging.getLogger(__name__)


class MesonGSStage(Stage):
    """Prunes a trained 3DGS scene, settles it on an octree, and trains it as the file will hold it.

    pruner  whose scores decide what goes; the own one takes the published beta of the scene where it has none
    """

    name = "mesongs"
    starts_from = "3dgs"

    def __init__(self, config: MesonGSConfig, pruner: Pruner) -> None:
        super().__init__(config)
        self.config, self.pruner = config, pruner
        self.values = self.looked_up(None)  # of the scene, once the stage begins

    def begin(self, context: StageContext) -> SplatModel:
        trained = context.model
        if not isinstance(trained, GaussianModel):
            raise TypeError(f"mesongs compresses a GaussianModel, not a {type(trained).__name__}")
        self.values = self.looked_up(context.scene)
        self._rasterizer, self._generator = context.rasterizer, context.generator("method")
        blocks = int(self.in_force()["codec.settings.blocks"])
        model = RahtGaussians.of(trained, bits=self.config.codec.settings.bits, blocks=blocks)
        model.active_sh_degree = model.max_sh_degree
        for frozen in (model.means, model.sh_rest):
            frozen.requires_grad_(False)
        return model

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        groups = [ParamGroup(name, lr) for name, lr in self.rates(0, scene).items()]
        self._optimizer = SplatOptimizer(model, groups)
        return self._optimizer

    def in_force(self) -> dict[str, float]:
        """Return the values that depend on the scene, by key: those of the configuration, else the published ones."""
        return {key: self.values[key] if given is None else given for key, given in self._given().items()}

    def looked_up(self, scene: Scene | None) -> dict[str, float]:
        """Return the published values of a scene, by key, of what the configuration leaves open; None: of any other."""
        values = self._published(scene)
        found = {
            "prune.tau": values.tau,
            "prune.settings.beta": values.beta,
            "codec.settings.depth": values.depth,
            "codec.settings.blocks": values.blocks,
            "codec.settings.codebook_size": values.codebook_size,
            "lr.factor": values.lr_factor,
        }
        return {key: found[key] for key, given in self._given().items() if given is None}

    def _published(self, scene: Scene | None) -> Published:
        """Return the published values of a scene; None: of any that is not listed."""
        authors = self.config.authors
        return published("" if scene is None else scene.name, authors.family, authors.point)

    def _given(self) -> dict[str, float | None]:
        """Return what the configuration says of the values that depend on the scene; None: it leaves them open.

        Another pruner than the own one has no beta.
        """
        config, settings = self.config, self.config.codec.settings
        return {
            "prune.tau": config.prune.tau,
            **({"prune.settings.beta": self.pruner.beta} if isinstance(self.pruner, Importance) else {}),
            "codec.settings.depth": settings.depth,
            "codec.settings.blocks": settings.blocks,
            "codec.settings.codebook_size": settings.codebook_size,
            "lr.factor": config.lr.factor,
        }

    def rates(self, step: int, scene: Scene) -> dict[str, float]:
        """Return the step size of each parameter at a step of this run."""
        share = min(step / (self.config.FULL_ITERATIONS * self.config.schedule_scale or 1), 1.0)
        return self.config.lr.of_step(share, self.in_force()["lr.factor"], scene.extent)

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        scheduler.register_task(1, self.score_and_prune, name="calculate importance score and prune")
        scheduler.register_task(1, self.settle, name="create octree")
        scheduler.register_task(self.when(range(self.config.FULL_ITERATIONS)), self.update_rates, name="update lr")

    def score_and_prune(
        self,
        model: RahtGaussians,
        optimizer: SplatOptimizer,
        cameras: CameraIterator,
        rasterizer: Rasterizer,
        scene: Scene,
        step: int,
        told: TaskLog | None = None,
    ) -> None:
        """Remove all Gaussians up to the score at the share tau; the others keep their importance.

        It tells the values that depend on the scene, since the configuration leaves open what is looked up by its name.
        The importance weighs the colours in the codebook, whoever decides what goes; beside another pruner its beta is
        the published one. Those of the highest score stay where all would go. Raises SceneError if no training view
        shows any.
        """
        values = self.in_force()
        beta = values.get("prune.settings.beta", self._published(scene).beta)
        shown = values if isinstance(self.pruner, Importance) else {**values, "beta of the colours' weights": beta}
        line = f"scene '{scene.name}': {', '.join(f'{key} = {value:g}' for key, value in shown.items())}"
        if told is not None:
            told.say(line)
        else:
            log.info(line)
        importance = Importance(beta=beta)
        scores = scores_of(importance, model, cameras, rasterizer, scene)
        model.importance.copy_(scores)
        if not isinstance(self.pruner, Importance):
            scores = scores_of(self.pruner, model, cameras, rasterizer, scene)
        doomed = up_to(scores, values["prune.tau"])
        if bool(doomed.all()):  # of one Gaussian, or of equal scores, all are up to the lowest at any share
            if not bool(model.importance.any()):
                raise SceneError(
                    f"no training view of '{scene.name}' shows a Gaussian of the trained scene: compare its poses with "
                    "those of the scene that it was trained on",
                    path=scene.path,
                )
            doomed = scores < scores.max()
        before, gone = model.num_rows, int(doomed.sum())
        optimizer.keep_rows(model, ~doomed)
        log.info("step %d: pruned %d of %d Gaussians, %d left", step, gone, before, before - gone)

    def settle(self, model: RahtGaussians, optimizer: SplatOptimizer) -> None:
        """Merge the Gaussians of each voxel, and train the codebook of their SH bands 1 to 3."""
        values, before = self.in_force(), model.num_rows
        model.settle(
            optimizer, self.config.codec.settings, generator=self._generator,
            depth=int(values["codec.settings.depth"]), size=int(values["codec.settings.codebook_size"]),
        )  # fmt: skip
        log.info("%d Gaussians in %d voxels, %d codebook entries", before, model.num_rows, len(model.codebook))

    def update_rates(self, optimizer: SplatOptimizer, scene: Scene, step: int) -> None:
        """Set the step sizes; with lr.final 1, as published, they stay what they are."""
        for name, lr in self.rates(step, scene).items():
            optimizer.set_lr(name, lr)

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        truth = view.image(background, result.image.device)
        return photometric_loss(result.image, truth, lambda_dssim=self.config.lambda_dssim)

    @torch.no_grad()
    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        """Return the model, settled now if there was no step to do it at."""
        assert isinstance(model, RahtGaussians)
        if model.grid is None:
            self.score_and_prune(model, self._optimizer, CameraIterator(scene.train), self._rasterizer, scene, 0)
            self.settle(model, self._optimizer)
        if self.config.codec.settings.recalibrate:
            model.recalibrate()
        return model
