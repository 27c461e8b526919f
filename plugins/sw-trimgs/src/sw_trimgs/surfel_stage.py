"""TrimGS on surfels: the fine-tuning of a 2DGS scene, and the stage of 2DGS with splits and trims of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from sw_gaussians.control_tasks import Change
from sw_gaussians.density.adc import AdaptiveDensityControl
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.surface import surface_depth
from sw_gaussians.surface_losses import add_surface_losses, maps_for
from sw_gaussians.surfels import Surface, SurfelModel
from sw_gaussians.wrapped_stage import WrappedStage

from splatwizard_core.api import EmptyModel, RasterOptions, UserInputError
from sw_trimgs.normals import smooth_pixels
from sw_trimgs.scale_split import ScaleSplit
from sw_trimgs.stage import TrimStage
from sw_trimgs.trimming import Trim

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import (
        LossPack,
        Method,
        OptimizationParams,
        PipelineParams,
        PluginManager,
        RenderResult,
        Scheduler,
        SplatModel,
        StageContext,
        View,
    )
    from sw_trimgs.surfel_config import ScratchConfig, ScratchSurface, SurfaceTuning, Trim2DGSConfig

SPLIT, TRIM, RESET = 1, 2, 3
"""Priorities within a step, after 2DGS' own density control."""


class TrimSurfelStage(TrimStage):
    """The fine-tuning of surfels, with distortion and normal consistency from the first step on."""

    def __init__(self, config: Trim2DGSConfig, plugins: PluginManager) -> None:
        super().__init__(config, plugins)
        self.settings, self.drop_masked = config.surface, config.drop_masked
        self.depth_ratio = config.surface.depth_ratio or 0.0  # that of the model is known when the stage begins

    @property
    def starts_from(self) -> str | None:
        return "2dgs"

    def begin(self, context: StageContext) -> SplatModel:
        """Return the surfels to train. Raises UserInputError for other Gaussians, EmptyModel if no mask has any."""
        model = super().begin(context)
        if not isinstance(model, SurfelModel):
            raise UserInputError(
                "trim-2dgs starts from surfels, which have two scales each, and this scene has three: "
                "use trim-3dgs, or the .ply of a 2dgs scene"
            )
        settings = self.settings
        if settings.depth_ratio is None:
            self.depth_ratio = 0.0 if model.surface is None else model.surface.depth_ratio
        if self.drop_masked:
            model = within_masks(model, context.scene.train)
        model.surface = Surface(self.depth_ratio, settings.lambda_dist, settings.lambda_normal)
        self._options = None
        return model

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        if self._options is None or self._options.background is not background:
            settings = self.settings
            maps = maps_for(
                distortion=settings.lambda_dist > 0, normals=settings.lambda_normal > 0, depth_ratio=self.depth_ratio
            )
            self._options = RasterOptions(background=background, grad2d=True, **maps)
        return self._options

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        pack, settings = super().loss(model, view, result, background, step), self.settings
        mask = smooth_surface(result, self.depth_ratio, settings) if settings.lambda_normal > 0 else None
        return add_surface_losses(
            pack, result, view.camera, self.depth_ratio,
            distortion=settings.lambda_dist, normals=settings.lambda_normal, term=settings.normal_term, mask=mask,
        )  # fmt: skip


def smooth_surface(result: RenderResult, depth_ratio: float, settings: SurfaceTuning | ScratchSurface) -> Tensor:
    """[1,H,W], 1 where the surface has no edge near by and 0 elsewhere, without gradient (`smooth_pixels`)."""
    return smooth_pixels(surface_depth(result.depth, depth_ratio), settings.edge_threshold, settings.erosion)


@torch.no_grad()
def within_masks(model: SurfelModel, views: Sequence[View]) -> SurfelModel:
    """Return a copy without the surfels whose centre lies inside a view's image and outside that view's mask.

    The mask of a view is its own, else where its picture's alpha is at least a half; a view without either says
    nothing. Raises EmptyModel if nothing is left.
    """
    keep = torch.ones(model.num_rows, dtype=torch.bool, device=model.device)
    for view in views:
        mask = mask_of(view)
        if mask is None:
            continue
        camera = view.camera.to(model.device)
        x, y, z = (model.means @ camera.R.T + camera.tau).unbind(dim=1)
        safe = torch.where(z > 0, z, 1)
        u = (camera.fx * x / safe + camera.cx).floor().long()
        v = (camera.fy * y / safe + camera.cy).floor().long()
        inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        hit = mask.to(model.device)[v.clamp(0, camera.height - 1), u.clamp(0, camera.width - 1)]
        keep &= ~inside | hit
    if not bool(keep.any()):
        raise EmptyModel(0)
    kept = SurfelModel(*(getattr(model, name).detach()[keep].clone() for name in model.RAW))
    kept.split_seed, kept.active_sh_degree, kept.surface = model.split_seed, model.active_sh_degree, model.surface
    return kept


def mask_of(view: View) -> Tensor | None:
    """Bool [H,W] or None: the mask of a view, or the opaque half of its picture."""
    if view.mask is not None:
        return view.mask
    return view.pixels[3] >= 128 if view.load is not None and view.pixels.shape[0] == 4 else None


class ScratchStage(WrappedStage):
    """The stage of 2DGS with the scale split after its densifications, trims, and normals that leave out edges.

    base    the configured method 2dgs, whose one stage it is; its own normal loss is off
    """

    def __init__(self, config: ScratchConfig, base: Method, plugins: PluginManager) -> None:
        (inner,) = base.stages()
        super().__init__(inner, config)
        self.name = "trim-2dgs-scratch"
        self.config = config
        self.pruner = config.trim.load(plugins, "trim.pruner")
        self.depth_ratio = config.surface.depth_ratio or 0.0
        self._maps: tuple[RasterOptions, RasterOptions] | None = None

    @property
    def iterations(self) -> int:
        return self.config.iterations

    def begin(self, context: StageContext) -> SplatModel:
        model = self.inner.begin(context)
        assert isinstance(model, SurfelModel)
        assert model.surface is not None  # the stage of 2dgs says it
        self.depth_ratio = model.surface.depth_ratio
        model.surface = replace(model.surface, lambda_normal=self.config.surface.lambda_normal)
        self._maps = None
        return model

    @property
    def trims(self) -> list[int]:
        """Steps of this run that trim."""
        trim = self.config.trim
        full = [step for step in range(0, trim.stop, trim.interval) if step > trim.after]
        found = self.when(full)
        assert isinstance(found, list)
        return found

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_post_task(scheduler, ppl, opt)
        scheduler.reprioritise(Change, RESET)
        split = self.config.densify
        assert isinstance(self.inner, ThreeDGSStage)
        control, lr = self.inner.control, self.inner.config.lr.opacity
        task = ScaleSplit(
            percent_dense=split.percent_dense,
            factor=split.factor,
            size_px=None,
            # As 2DGS prunes: lower where a scaled plan leaves few steps after a reset.
            min_opacity=control.min_opacity(lr) if isinstance(control, AdaptiveDensityControl) else 0.0,
            box=split.box,
        )
        steps = self.when(range(split.start, split.stop, split.interval))
        scheduler.register_task(steps, task, priority=SPLIT, name="scale split")
        trims, trim = self.trims, self.config.trim
        if trims:
            first = min(trims) if trim.unseen else None
            scheduler.register_task(trims, Trim(self.pruner, trim.ratio, first=first), priority=TRIM, name="trim")

    def weight(self, step: int) -> float:
        """Return the weight of the normals at a step; 0 until theirs has come."""
        surface = self.config.surface
        return surface.lambda_normal if step > surface.normal_after * self.opt.schedule_scale else 0.0

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        options = self.inner.raster_options(step, background)
        if self.weight(step) == 0:
            return options
        if self._maps is None or self._maps[0] is not options:
            maps = maps_for(distortion=options.distortion, normals=True, depth_ratio=self.depth_ratio)
            self._maps = options, replace(options, **maps)
        return self._maps[1]

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        pack, weight, surface = (
            self.inner.loss(model, view, result, background, step),
            self.weight(step),
            self.config.surface,
        )
        if weight == 0:
            return pack
        mask = smooth_surface(result, self.depth_ratio, surface)
        return add_surface_losses(
            pack, result, view.camera, self.depth_ratio, normals=weight, term=surface.normal_term, mask=mask
        )
