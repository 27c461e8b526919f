"""HAC++ as a method: its model of a scene, its training stage, its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.api import ConfigError, Method, SceneError
from sw_hac_plus import codec
from sw_hac_plus.channel_mixture import PARTS, ChannelMixture
from sw_hac_plus.config import HACPlusConfig
from sw_hac_plus.model import HACPlusAnchors
from sw_hac_plus.presets import BY_DATASET, PRESETS, RATES
from sw_hac_plus.stage import HACPlusStage
from sw_hac_plus.voxel_lattice import check_reach

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class HACPlus(Method):
    """Chen, Wu, Lin, Harandi, Cai: HAC++: Towards 100X Compression of 3D Gaussian Splatting, TPAMI 2025.

    Source: arXiv 2501.12255, and published facts about the authors' code.
    """

    name: ClassVar[str] = "hac-plus"
    version: ClassVar[int] = 1
    Config = HACPlusConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    BY_DATASET: ClassVar[Mapping[str, Mapping[str, Any]]] = BY_DATASET
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r4"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Put an anchor into every voxel with a start point of the scene.

        Raises SceneError if there is none, or if they reach over more voxels than a file has.
        """
        config: HACPlusConfig = self.config
        model = HACPlusAnchors.of_scene(
            scene, config, generator, channel=self.channel(generator),
            anchor_gradient=config.rate_term.anchor_gradient,
        )  # fmt: skip
        try:
            check_reach(model.anchors, model.voxel_size)  # now, not after the training
        except ValueError as error:
            raise SceneError(f"scene '{scene.name}': {error}", path=scene.path) from None
        return model

    def channel(self, generator: torch.Generator) -> ChannelMixture | None:
        """Return a new channel context, None for kind "none". Raises ConfigError unless its slices are the features."""
        config: HACPlusConfig = self.config
        c = config.channel
        if c.kind == "none":
            return None
        if sum(c.slices) != config.feature_dim:
            raise ConfigError(
                f"channel.slices {c.slices} must sum to feature_dim {config.feature_dim}", key="channel.slices"
            )
        full = c.kind == "full"
        return ChannelMixture(
            c.slices, context=PARTS * config.feature_dim if full else 0, hidden=c.hidden if full else None,
            scale=c.init_scale, generator=generator,
        )  # fmt: skip

    def stages(self) -> Sequence[Stage]:
        stage = HACPlusStage(self.config, pictures=self.config.pictures.load(self.plugins))
        if self.config.size:
            lead, first = self.plugins.tasks.load("lead-to-size"), stage.at(self.config.phases.entropy)
            lead(self.config.size, self.name, first, stage.iterations).lead(stage)
        return [stage]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, HACPlusAnchors):
            raise TypeError(f"hac-plus encodes its own anchors, not a {type(model).__name__}")
        codec.encode(model, writer, self.config.codec.settings, self.plugins)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return codec.decode(reader, self.plugins)
