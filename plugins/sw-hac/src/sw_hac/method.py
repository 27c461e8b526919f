"""HAC as a method: its model of a scene, its training stage, its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.api import Method
from sw_hac import codec
from sw_hac.config import HACConfig
from sw_hac.model import HACAnchors
from sw_hac.presets import BY_DATASET, PRESETS, RATES
from sw_hac.stage import HACStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class HAC(Method):
    """Chen, Wu, Lin, Harandi, Cai: HAC: Hash-grid Assisted Context for 3D Gaussian Splatting Compression, ECCV 2024.

    Source: arXiv 2403.14530.
    """

    name: ClassVar[str] = "hac"
    version: ClassVar[int] = 1
    Config = HACConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    BY_DATASET: ClassVar[Mapping[str, Mapping[str, Any]]] = BY_DATASET
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r4"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Put an anchor into every voxel with a start point of the scene."""
        return HACAnchors.of_scene(scene, self.config, generator)

    def stages(self) -> Sequence[Stage]:
        stage = HACStage(self.config, pictures=self.config.pictures.load(self.plugins))
        if self.config.size:
            lead, first = self.plugins.tasks.load("lead-to-size"), stage.at(self.config.phases.entropy)
            lead(self.config.size, self.name, first, stage.iterations).lead(stage)
        return [stage]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, HACAnchors):
            raise TypeError(f"hac encodes its own anchors, not a {type(model).__name__}")
        codec.encode(model, writer, self.config.codec.settings, self.plugins)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return codec.decode(reader, self.plugins)
