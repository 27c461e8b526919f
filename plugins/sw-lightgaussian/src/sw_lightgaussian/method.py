"""LightGaussian: prune a trained 3DGS scene by global significance, distil it, vector-quantise its colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod

from splatwizard_core.api import ConfigError, create_method
from sw_lightgaussian.config import LightGaussianConfig
from sw_lightgaussian.presets import PRESETS, RATES
from sw_lightgaussian.stages import DistillStage, PruneStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import Scene, SplatModel, Stage


class LightGaussian(GaussianMethod):
    """Fan, Wang, Wen, Zhu, Xu, Wang: LightGaussian: Unbounded 3D Gaussian Compression with 15x Reduction and 200+ FPS.

    Source: arXiv 2311.17245 (NeurIPS 2024), and facts about the authors' code where the two differ.
    """

    name: ClassVar[str] = "lightgaussian"
    version: ClassVar[int] = 1
    Config = LightGaussianConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r3"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Return the start of a 3DGS scene; the first stage trains a finished one instead."""
        return create_method(self.plugins, "3dgs").create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        config: LightGaussianConfig = self.config
        prune, keep = config.prune.load(self.plugins), config.score.load(self.plugins, "score.pruner")
        if keep.uses_statistics:
            raise ConfigError(
                f"score.pruner '{config.score.pruner}' reads statistics of a densification; there is none here",
                key="score.pruner",
            )
        return [PruneStage(config, prune), DistillStage(config, keep)]
