"""3D Gaussian Splatting: the method that the others start from, and the baseline that they are compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.ply import load_ply
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.api import GaussianModel, Method, SceneError
from sw_3dgs.config import ThreeDGSConfig
from sw_3dgs.presets import PRESETS, RATES
from sw_codecs.models import exact, quantized

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class ThreeDGS(Method):
    """Kerbl, Kopanas, Leimkühler, Drettakis: 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023.

    Source: arXiv 2308.04079, and the authors' code where the two differ.
    """

    name: ClassVar[str] = "3dgs"
    version: ClassVar[int] = 1
    Config = ThreeDGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r6"  # exact: what the literature calls the size of 3DGS

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Gaussians of the .ply that `init` names, else one for each start point of the scene."""
        config: ThreeDGSConfig = self.config
        if config.init:
            return load_ply(config.init)
        if scene.points is None or len(scene.points) == 0:
            raise SceneError(
                f"scene '{scene.name}' has no start points: 3DGS needs SfM points, random ones, or --set init=FILE.ply",
                path=scene.path,
            )
        if not config.mcmc.enabled:
            return gaussians_from_points(scene.points, max_sh_degree=config.sh_degree)
        return gaussians_from_points(
            scene.points,
            max_sh_degree=config.sh_degree,
            opacity=config.mcmc.init_opacity,
            scale_factor=config.mcmc.init_scale,
        )

    def stages(self) -> Sequence[Stage]:
        return [ThreeDGSStage(self.config)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, GaussianModel):
            raise TypeError(f"3dgs encodes a GaussianModel, not a {type(model).__name__}")
        codec = self.config.codec
        writer.static["mode"] = codec.mode
        if codec.mode == "exact":
            exact.encode(model, writer)
        else:
            quantized.encode(model, writer, codec, self.plugins)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        if reader.text("mode", choices=("exact", "quantized")) == "exact":
            return exact.decode(reader)
        return quantized.decode(reader, self.plugins)
