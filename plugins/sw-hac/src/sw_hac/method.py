"""HAC as a method: its model of a scene, its training stage, its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_anchors.dataset_values import BY_DATASET
from sw_anchors.grid_anchors import GridAnchors
from sw_anchors.grid_stage import GridStage

from splatwizard_core.api import Method
from sw_hac import codec
from sw_hac.config import HACConfig
from sw_hac.presets import PRESETS, RATES

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class HACStage(GridStage):
    """One stage of 30,000 steps."""

    name = "hac"


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
        return GridAnchors.of_scene(scene, self.config, generator)

    def stages(self) -> Sequence[Stage]:
        return [HACStage(self.config)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, GridAnchors):
            raise TypeError(f"hac encodes its own anchors, not a {type(model).__name__}")
        codec.encode(model, writer, self.config.codec.settings)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return codec.decode(reader)
