"""Trimming the Fat: Efficient Compression of 3D Gaussian Splats through Pruning."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.coding.gaussian_codec import check_gaussian_codec, decode_gaussians, encode_gaussians
from splatwizard_core.errors import SceneError
from splatwizard_core.experiments.method import Method
from sw_trimming_the_fat.config import TrimmingTheFatConfig
from sw_trimming_the_fat.presets import PRESETS, RATES
from sw_trimming_the_fat.stage import TrimmingStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.gaussians.splat_model import SplatModel
    from splatwizard_core.scene.scene import Scene
    from splatwizard_core.training.stage import Stage


class TrimmingTheFat(Method):
    """Ali, Qamar, Bae, Tartaglione: Trimming the Fat, BMVC 2024 (arXiv 2406.18214)."""

    name: ClassVar[str] = "trimming-the-fat"
    version: ClassVar[int] = 1
    Config = TrimmingTheFatConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r3"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Nothing: it has no start of its own."""
        raise SceneError(f"{self.name} starts from a trained 3dgs scene, not from points", path=scene.path)

    def stages(self) -> Sequence[Stage]:
        check_gaussian_codec(self.plugins, self.config.codec)
        return [TrimmingStage(self.config, self.plugins)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        encode_gaussians(self.plugins, self.config.codec, model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return decode_gaussians(self.plugins, reader)
