"""The fine-tuning of TrimGS, and its form for flat Gaussians, with the regularisation by normals."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from sw_gaussians.finetune.fine_tuning import FineTuningStage
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.statistics import collect_statistics
from sw_gaussians.tasks import PruneAndDensify, ResetOpacity

from splatwizard_core.api import GaussianModel, LossPack, RasterOptions
from sw_trimgs.flat import FlatGaussians, flattened
from sw_trimgs.normals import near_surface, normal_difference, roughness, smooth_pixels
from sw_trimgs.scale_split import ScaleSplit
from sw_trimgs.surface_state import DrawSurface, forget_neighbors
from sw_trimgs.trimming import Trim

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import (
        OptimizationParams,
        PipelineParams,
        PluginManager,
        RenderResult,
        Scene,
        Scheduler,
        SplatModel,
        StageContext,
        View,
        When,
    )
    from sw_trimgs.config import Normals, Trim3DGSConfig, TuneConfig

LAST = 1
"""Priority of what comes after everything else that a step does to the rows."""


class FlatStage(ThreeDGSStage):
    """The 3DGS stage on flat Gaussians."""

    name = "flat-3dgs"

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        assert isinstance(model, FlatGaussians)
        model.settle()
        return super().finish(model, scene)


class TrimStage(FineTuningStage):
    """Goes on from a trained scene with densification by scale, and trims what contributes least.

    config      its plan, see config.py

    Raises ConfigError for a pruner that is not installed.
    """

    name = "tune"
    statistics = True
    rates_plan = range(7_000)

    def __init__(self, config: TuneConfig, plugins: PluginManager) -> None:
        super().__init__(config, config.lr, lambda_dssim=config.lambda_dssim)
        self.densify, self.trim = config.densify, config.trim
        self.pruner = config.trim.load(plugins, "trim.pruner")

    def begin(self, context: StageContext) -> SplatModel:
        model = super().begin(context)
        if isinstance(model, GaussianModel):
            model.split_seed = context.generator("split").initial_seed()
        return model

    @property
    def densifications(self) -> When:
        """Steps of this run that densify."""
        return self.when(range(0, self.densify.stop, self.densify.interval))

    @property
    def trims(self) -> list[int]:
        """Steps of this run that trim: those after `trim.after` where a densification is due too."""
        both = range(0, self.densify.stop, self.trim.interval)
        full = [step for step in both if step > self.trim.after and step % self.densify.interval == 0]
        found = self.when(full)
        assert isinstance(found, list)
        return found

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        densify = self.densify
        scheduler.register_task(self.when(range(densify.stop)), collect_statistics, name="collect gradient statistics")
        if densify.mode != "scale":
            scheduler.register_task(self.densifications, self.ordinary(), name="prune and densify")
        if densify.mode != "ordinary":
            scheduler.register_task(self.densifications, self.scale_split(), name="scale split")
        trims = self.trims
        if trims:
            task = Trim(self.pruner, self.trim.ratio, first=min(trims) if self.trim.unseen else None)
            scheduler.register_task(trims, task, name="trim")
        if densify.reset_interval:
            reset = ResetOpacity(ceiling=densify.reset_opacity)
            scheduler.register_task(
                self.when(range(0, densify.stop, densify.reset_interval)), reset, name="reset opacity"
            )

    def ordinary(self) -> PruneAndDensify:
        """Return the density control of 3DGS; what is too large is pruned from the first time on."""
        densify = self.densify
        return PruneAndDensify(
            grad_threshold=densify.grad_threshold,
            percent_dense=densify.percent_dense,
            min_opacity=densify.min_opacity,
            world_prune=densify.world_prune,
            size_rules_after=0,
        )

    def scale_split(self) -> ScaleSplit:
        """Return the scale split."""
        densify = self.densify
        return ScaleSplit(
            percent_dense=densify.percent_dense,
            factor=densify.factor,
            size_px=densify.size_px,
            min_opacity=densify.min_opacity,
            box=densify.box,
        )


class TrimFlatStage(TrimStage):
    """The fine-tuning of flat Gaussians, whose normals follow the depth map and their neighbours."""

    def __init__(self, config: Trim3DGSConfig, plugins: PluginManager) -> None:
        super().__init__(config, plugins)
        self.start, self.normals = config.start, config.normals

    @property
    def starts_from(self) -> str | None:
        return self.start

    def begin(self, context: StageContext) -> SplatModel:
        model = super().begin(context)
        assert isinstance(model, GaussianModel)
        flat = flattened(model)
        flat.split_seed = model.split_seed
        return flat

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_pre_task(scheduler, ppl, opt)
        normals = self.normals
        if normals.weight == 0:
            return
        scale = self.opt.schedule_scale
        after, refresh = round(normals.after * scale), max(1, round(normals.refresh * scale))
        task = DrawSurface(normals.neighbors, first=after + 1, refresh=refresh)
        scheduler.register_task(range(after + 1, max(after + 1, self.iterations) + 1), task, name="draw normals")

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_post_task(scheduler, ppl, opt)
        if self.normals.weight > 0:
            scheduler.register_task(self.densifications, forget_neighbors, priority=LAST, name="forget neighbours")

    def scale_split(self) -> ScaleSplit:
        """Return the scale split; in mode mix it prunes what is too large once more."""
        split = super().scale_split()
        if self.densify.mode == "mix":
            split.world_prune = self.densify.world_prune
        return split

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        if self._options is None or self._options.background is not background:
            # The published kernels leave the geometry out of the gradient of depth and normals, on purpose.
            self._options = RasterOptions(background=background, grad2d=True, features_detach_geometry=True)
        return self._options

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        loss = super().loss(model, view, result, background, step)
        if result.features is None or not isinstance(model, FlatGaussians):
            return loss
        return regularised(loss, model, view, result, self.normals)

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        assert isinstance(model, FlatGaussians)
        model.settle()
        return super().finish(model, scene)


def regularised(loss: LossPack, model: FlatGaussians, view: View, result: RenderResult, settings: Normals) -> LossPack:
    """Add how far the drawn normals are from the depth map's, and Gaussians' normals from their neighbours'.

    A term that is not finite is left out, as in the authors' code.
    """
    features, inputs = result.features, result.inputs
    assert features is not None
    assert inputs.features is not None
    camera = view.camera.to(features.device)
    depth, drawn = features[:1], features[1:]
    mask = smooth_pixels(depth, settings.edge_threshold, settings.erosion)
    chosen = result.visible & near_surface(inputs.means, depth, camera, settings.close)
    terms = {
        "normal": normal_difference(drawn, depth, camera, mask, settings.reach),
        "rough": roughness(inputs.features[:, 1:], model.neighbors, chosen),
    }
    finite = {name: term for name, term in terms.items() if bool(torch.isfinite(term))}
    total = loss.total
    for term in finite.values():
        total = total + settings.weight * term
    return LossPack(total, loss.parts | {name: term.detach() for name, term in finite.items()})
