"""The training stage of 2DGS: that of 3DGS on surfels, with two losses that make a surface of them."""

from __future__ import annotations

import functools
import logging
from dataclasses import replace
from typing import TYPE_CHECKING

from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.surface_losses import add_surface_losses, maps_for
from sw_gaussians.surfels import Surface, SurfelModel

from splatwizard_core.api import ConfigError, DensityControl, RasterOptions
from sw_2dgs.datasets import OTHER, surface_of
from sw_2dgs.surface_slopes import surface_slopes

if TYPE_CHECKING:
    from sw_gaussians.pictures import PictureSizes
    from torch import Tensor

    from splatwizard_core.api import Camera, LossPack, RenderResult, SplatModel, StageContext, TrainingState, View
    from sw_2dgs.config import TwoDGSConfig

log = logging.getLogger(__name__)


class TwoDGSStage(ThreeDGSStage):
    """Adam, L1 + SSIM and density control as in 3DGS; distortion and normal consistency once their steps have come.

    surface     depth ratio and weights; those of the data set are known when the stage begins
    """

    name = "2dgs"

    def __init__(
        self, opt: TwoDGSConfig, control: DensityControl | None = None, *, pictures: PictureSizes | None = None
    ) -> None:
        super().__init__(opt, control, pictures=pictures)
        self.settings = opt.surface
        self.surface = self._configured(OTHER)
        self._drawn: dict[tuple[bool, bool], RasterOptions] = {}  # by the losses that are on

    def _configured(self, default: Surface) -> Surface:
        """Return `default` with what the user set in its place."""
        given = {name: value for name, value in self.settings.model_dump().items() if value is not None}
        return replace(default, **{name: given[name] for name in vars(default) if name in given})

    def begin(self, context: StageContext) -> SplatModel:
        model = super().begin(context)
        if not isinstance(model, SurfelModel):
            raise ConfigError(
                f"stage '{self.name}' trains surfels, Gaussians with two scales; the given ones have three"
            )
        scene = context.scene
        self.surface = model.surface = self._configured(surface_of(scene.protocol.dataset, scene.name))
        self._drawn.clear()
        log.info("surface of %s (%s): %s", scene.name, scene.protocol.dataset, self.surface)
        return model

    def weights(self, step: int) -> tuple[float, float]:
        """Return the weights of distortion and normals at a step; 0 until their steps have come."""
        distortion, normals = self._after
        return self.surface.lambda_dist * (step > distortion), self.surface.lambda_normal * (step > normals)

    @functools.cached_property
    def _after(self) -> tuple[int, int]:
        """Steps of this run after which distortion and normals have weights."""
        return self.steps(self.settings.dist_after), self.steps(self.settings.normal_after)

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        """Ask for the maps of a loss only while it has a weight: without them drawing is as fast as for 3DGS."""
        plain = super().raster_options(step, background)
        distortion, normals = (weight > 0 for weight in self.weights(step))
        kept = self._drawn.get((distortion, normals))
        if kept is None or kept.background is not background:
            maps = maps_for(distortion=distortion, normals=normals, depth_ratio=self.surface.depth_ratio)
            kept = self._drawn[distortion, normals] = replace(plain, **maps)
        return kept

    def whole_step(
        self, state: TrainingState, view: View, camera: Camera, background: Tensor
    ) -> tuple[RenderResult, LossPack] | None:
        if type(self) is not TwoDGSStage or type(self.control).regularised is not DensityControl.regularised:
            return None
        terms = functools.partial(self.with_surface, view=view, step=state.step)
        return self.step_in_one(state, view, camera, background, terms)

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        return self.with_surface(super().loss(model, view, result, background, step), result, view=view, step=step)

    def with_surface(self, pack: LossPack, result: RenderResult, *, view: View, step: int) -> LossPack:
        """Return the loss plus the surface losses of this step."""
        distortion, normals = self.weights(step)
        given, term = (pack, result, view.camera, self.surface.depth_ratio), self.settings.normal_term
        found = surface_slopes(*given, distortion=distortion, normals=normals) if term == "code" else None
        return found or add_surface_losses(*given, distortion=distortion, normals=normals, term=term)
