"""LightGaussian: prune a trained 3DGS scene by global significance, distil it, vector-quantise its colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_finetuning.pruners import load_pruner

from splatwizard_core.api import ConfigError, GaussianModel, Method, create_method
from sw_lightgaussian.config import LightGaussianConfig
from sw_lightgaussian.presets import PRESETS, RATES
from sw_lightgaussian.significance import Significance
from sw_lightgaussian.stages import DistillStage, PruneStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class LightGaussian(Method):
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
        name, known = self.config.codec.name, self.plugins.gaussian_codecs
        if name not in known:
            raise ConfigError(
                f"no codec for Gaussians is called '{name}'; installed: {', '.join(known.names)}", key="codec.name"
            )
        score = self.config.score.model_dump()
        pruner = load_pruner(self.plugins, self.config.prune.pruner, {"lightgaussian": score})
        return [PruneStage(self.config, pruner), DistillStage(self.config, Significance(**score))]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, GaussianModel):
            raise TypeError(f"{self.name} encodes a GaussianModel, not a {type(model).__name__}")
        codec = self.config.codec
        settings: dict[str, Any] = {
            "ratio": codec.vq_ratio, "size": codec.codebook_size, "rows_per_code": codec.rows_per_code,
            "iterations": codec.vq_iterations, "batch": codec.vq_batch, "decay": codec.vq_decay,
            "reseed": codec.vq_reseed, "training": codec.vq_training,
        }  # fmt: skip
        writer.static["codec"] = codec.name
        make = self.plugins.gaussian_codecs.load(codec.name)
        make(self.plugins, **(settings if codec.name == "vectree" else {})).encode(model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        codecs = self.plugins.gaussian_codecs
        return codecs.load(reader.text("codec", choices=codecs.names))(self.plugins).decode(reader)
