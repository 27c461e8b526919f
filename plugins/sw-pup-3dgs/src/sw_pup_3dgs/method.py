"""PUP 3D-GS: Principled Uncertainty Pruning for 3D Gaussian Splatting."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.coding.gaussian_codec import check_gaussian_codec, decode_gaussians, encode_gaussians
from splatwizard_core.errors import SceneError
from splatwizard_core.experiments.method import Method
from sw_pup_3dgs.config import Pup3DGSConfig
from sw_pup_3dgs.presets import PRESETS, RATES
from sw_pup_3dgs.stage import PupStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.gaussians.splat_model import SplatModel
    from splatwizard_core.scene.scene import Scene
    from splatwizard_core.training.stage import Stage


class Pup3DGS(Method):
    """Hanson, Tu, Singla, Jayawardhana, Zwicker, Goldstein: PUP 3D-GS, CVPR 2025 (arXiv 2406.10219)."""

    name: ClassVar[str] = "pup-3dgs"
    version: ClassVar[int] = 1
    Config = Pup3DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r3"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Nothing: it has no start of its own."""
        raise SceneError(f"{self.name} starts from a trained 3dgs scene, not from points", path=scene.path)

    def stages(self) -> Sequence[Stage]:
        check_gaussian_codec(self.plugins, self.config.codec)
        return [PupStage(self.config, self.plugins)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        encode_gaussians(self.plugins, self.config.codec, model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return decode_gaussians(self.plugins, reader)
