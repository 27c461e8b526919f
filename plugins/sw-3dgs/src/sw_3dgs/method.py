"""3D Gaussian Splatting: the baseline method, and the start of most others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import HEADER_KEY, GaussianMethod
from sw_gaussians.stage import ThreeDGSStage
from sw_gaussians.start import gaussians_from_points, start_points
from sw_gaussians.surfels import refuse_surfels

from splatwizard_core.api import placed_in
from sw_3dgs.config import MODES, ThreeDGSConfig
from sw_3dgs.presets import PRESETS, RATES
from sw_3dgs.shared_stage import shared_stage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class ThreeDGS(GaussianMethod):
    """Kerbl, Kopanas, Leimkühler, Drettakis: 3D Gaussian Splatting for Real-Time Radiance Field Rendering, 2023.

    Source: arXiv 2308.04079, and the authors' code where the two differ.
    """

    name: ClassVar[str] = "3dgs"
    version: ClassVar[int] = 1
    Config = ThreeDGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = (
        "r3"  # a compressed file, as the other methods write; r6 is what the literature calls the size of 3DGS
    )

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Return the Gaussians of the .ply that `init` names, else one per start point of the scene."""
        config: ThreeDGSConfig = self.config
        if config.init:
            model = placed_in(self.plugins.read_gaussians(Path(config.init)), scene, str(config.init))
            refuse_surfels(model, f"init: {config.init}: method {self.name}")
            return model
        points = start_points(scene, "3DGS", instead="--set init=FILE.ply")
        start = config.density.load(self.plugins).start_values()
        return gaussians_from_points(points, max_sh_degree=config.sh_degree, **start)

    def stages(self) -> Sequence[Stage]:
        config: ThreeDGSConfig = self.config
        if config.batch > 1 or config.gpus > 1:
            return [shared_stage(config, self.plugins)]
        control, pictures = config.density.load(self.plugins), config.pictures.load(self.plugins)
        return [ThreeDGSStage(config, control, pictures=pictures, fuses_updates=config.fused_updates)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write the model with the chosen codec; the header names it in `mode`, other codecs in `codec`."""
        super().encode(model, writer)
        mode = next((mode for mode, name in MODES.items() if name == writer.static[HEADER_KEY]), None)
        if mode is not None:
            writer.static["mode"] = mode
            del writer.static[HEADER_KEY]

    def codec_of(self, reader: ContainerReader) -> str:
        return MODES[reader.text("mode", choices=list(MODES))] if "mode" in reader.static else super().codec_of(reader)
