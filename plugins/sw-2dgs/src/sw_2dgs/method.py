"""2D Gaussian Splatting: flat Gaussians, drawn by exact intersection of ray and plane, that form a surface."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod
from sw_gaussians.ply import load_ply
from sw_gaussians.start import start_points, surfels_from_points
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.api import SceneError, placed_in
from sw_2dgs.config import TwoDGSConfig
from sw_2dgs.presets import PRESETS, RATES
from sw_2dgs.stage import TwoDGSStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import Scene, SplatModel, Stage


class TwoDGS(GaussianMethod):
    """Huang, Yu, Chen, Geiger, Gao: 2D Gaussian Splatting for Geometrically Accurate Radiance Fields, SIGGRAPH 2024.

    Source: arXiv 2403.17888, and the authors' code where the two differ.
    """

    name: ClassVar[str] = "2dgs"
    version: ClassVar[int] = 1
    Config = TwoDGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r6"  # exact: what the literature calls the size of 2DGS

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Surfels of the .ply that `init` names, else one for each start point of the scene. Raises SceneError."""
        config: TwoDGSConfig = self.config
        if config.init:
            model = placed_in(load_ply(config.init), scene, str(config.init))
            if not isinstance(model, SurfelModel):
                raise SceneError(
                    f"init: {config.init} holds Gaussians with three scales each: 2dgs starts from surfels, which have "
                    "two, or from the scene's points",
                    path=config.init,
                )
            return model
        points = start_points(scene, "2DGS", instead="--set init=FILE.ply")
        return surfels_from_points(
            points, generator=generator, max_sh_degree=config.sh_degree, rotation=config.init_rotation,
            **config.density.load(self.plugins).start_values(),
        )  # fmt: skip

    def stages(self) -> Sequence[Stage]:
        config: TwoDGSConfig = self.config
        control, pictures = config.density.load(self.plugins), config.pictures.load(self.plugins)
        return [TwoDGSStage(config, control, pictures=pictures)]
