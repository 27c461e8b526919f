"""Weights of Gaussians in pictures, and errors of pictures of fewer of them, place by place."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sw_gaussians.made_up_cameras import plausible_cameras
from sw_gaussians.render_options import options_of

from splatwizard_core.api import Camera, GaussianModel, PluginManager, RasterOptions, SceneError, ScoreSpec
from splatwizard_core.tooling import NegotiatedRasterizer

VIEWS = 8
WIDEST = 480
"""Width of the pictures, pixels."""
LEAST = 1e-3
"""Weight of a Gaussian that no picture shows, of the mean."""


class Worth:
    """Pictures of a scene from cameras that are made up.

    raster  header values that say how the scene is drawn
    """

    def __init__(self, scene: GaussianModel, raster: Mapping[str, Any], plugins: PluginManager) -> None:
        self._rasterizer = NegotiatedRasterizer(plugins, device=scene.device, options=options_of(raster))
        self._cameras: list[Camera] = []
        with suppress(SceneError):  # nothing of it can be seen from anywhere
            self._cameras = plausible_cameras(scene, self._rasterizer, fit=VIEWS, held_out=1, widest=WIDEST).fit
        self._pictures = [self._drawn(scene, camera) for camera in self._cameras]

    def weights(self, scene: GaussianModel) -> NDArray[np.float64]:
        """Of each Gaussian [N] of the scene, above 0: the squared change of all pictures by that of its colour."""
        found = sum((self._sums(scene, camera, ScoreSpec("weight", "blend_sq")) for camera in self._cameras),
                    np.zeros(scene.num_rows))  # fmt: skip
        return found + (LEAST * found.mean() if found.any() else 1.0)

    def errors(self, model: GaussianModel) -> NDArray[np.float64]:
        """Squared error of all pictures by the Gaussians [M] that show where it is, by their share of each pixel."""
        pairs = zip(self._cameras, self._pictures, strict=True)
        return self._shares(model, [self._drawn(model, camera) - picture for camera, picture in pairs])

    def energies(self, scene: GaussianModel) -> NDArray[np.float64]:
        """The pictures of the scene itself, squared, by its Gaussians [N] as errors are."""
        return self._shares(scene, self._pictures)

    def _shares(self, model: GaussianModel, pictures: list[torch.Tensor]) -> NDArray[np.float64]:
        found = np.zeros(model.num_rows)
        for camera, picture in zip(self._cameras, pictures, strict=True):
            spec = ScoreSpec("share", "blend", pixel_weight=picture.square().sum(dim=0))
            found += self._sums(model, camera, spec)
        return found

    @torch.no_grad()
    def _drawn(self, model: GaussianModel, camera: Camera) -> torch.Tensor:
        return self._rasterizer.render(model.gaussians(camera, self._rasterizer), camera, RasterOptions()).image

    @torch.no_grad()
    def _sums(self, model: GaussianModel, camera: Camera, spec: ScoreSpec) -> NDArray[np.float64]:
        inputs = model.gaussians(camera, self._rasterizer)
        scores = self._rasterizer.accumulate(inputs, [camera], RasterOptions(scores=(spec,))).scores
        return scores[spec.name].double().cpu().numpy()
