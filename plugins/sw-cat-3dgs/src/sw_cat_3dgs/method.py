"""CAT-3DGS as a method: its model of a scene, its training stage, its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.api import ConfigError, Method, SceneError
from sw_cat_3dgs import codec
from sw_cat_3dgs.config import CatConfig
from sw_cat_3dgs.context import CatContext, ContextShape
from sw_cat_3dgs.model import CatAnchors
from sw_cat_3dgs.presets import BY_DATASET, PRESETS, RATES
from sw_cat_3dgs.stage import CatStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class Cat3DGS(Method):
    """Zhan, Ho, Yang, Chen, Chiang, Liu, Peng: CAT-3DGS, a context-adaptive triplane approach to
    rate-distortion-optimized 3DGS compression, ICLR 2025.

    Source: arXiv 2503.00357, and published facts about the authors' code. On the anchors of Scaffold-GS
    (arXiv 2312.00109) as compressed by HAC (arXiv 2403.14530).
    """

    name: ClassVar[str] = "cat-3dgs"
    version: ClassVar[int] = 1
    Config = CatConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    BY_DATASET: ClassVar[Mapping[str, Mapping[str, Any]]] = BY_DATASET
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r6"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Put an anchor into every voxel with a start point of the scene."""
        config: CatConfig = self.config
        if scene.points is None or len(scene.points) == 0:
            raise SceneError(
                f"scene '{scene.name}' has no start points: anchors need SfM points, or random ones", path=scene.path
            )
        context = CatContext(self.shape(), generator)
        if config.context.start == "network":
            context.start_slices_at_random(generator)
        context.in_steps = config.context.units == "steps"
        return CatAnchors.from_points(
            scene.points, voxel_size=config.voxel_size, num_offsets=config.num_offsets, feature_dim=config.feature_dim,
            hidden=config.hidden, generator=generator, margin=config.margin, sample=config.rate_term.sample,
            view_factor=config.rate_term.view_factor, scale_floor=config.rate_term.scale_floor, context=context,
        )  # fmt: skip

    def shape(self) -> ContextShape:
        """Sizes of the context model. Raises ConfigError if the slices do not make up the features."""
        config: CatConfig = self.config
        c = config.context
        if sum(c.slices) != config.feature_dim or min(c.slices) < 1:
            raise ConfigError(
                f"context.slices {c.slices} must be positive and sum to feature_dim {config.feature_dim}",
                key="context.slices",
            )
        if not all(1 <= m <= 16 for m in c.multiples):
            raise ConfigError(f"context.multiples {c.multiples} must be in 1..16", key="context.multiples")
        return ContextShape(
            config.feature_dim, config.num_offsets, c.channels, tuple(c.multiples), c.hidden, tuple(c.slices),
            c.slice_hidden, c.refine, (1.0, config.steps.scales, config.steps.offsets),
        )  # fmt: skip

    def stages(self) -> Sequence[Stage]:
        stage = CatStage(self.config, pictures=self.config.pictures.load(self.plugins))
        if self.config.size:
            lead, first = self.plugins.tasks.load("lead-to-size"), stage.at(self.config.phases.planes)
            lead(self.config.size, self.name, first, stage.iterations).lead(stage)
        return [stage]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, CatAnchors):
            raise TypeError(f"cat-3dgs encodes its own anchors, not a {type(model).__name__}")
        codec.encode(model, writer, self.config, self.plugins)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return codec.decode(reader, self.plugins)
