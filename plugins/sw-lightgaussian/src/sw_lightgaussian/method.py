"""LightGaussian: prune a trained 3DGS scene by global significance, distil it, vector-quantise its colours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.api import Method, create_method, load_pruner
from splatwizard_core.coding.gaussian_codec import check_gaussian_codec, decode_gaussians, encode_gaussians
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
        """Of no use to the first stage, which starts from a trained 3DGS scene: the start of such a scene."""
        return create_method(self.plugins, "3dgs").create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        check_gaussian_codec(self.plugins, self.config.codec.name, "codec.name")
        score = self.config.score.model_dump()
        pruner = load_pruner(self.plugins, self.config.prune.pruner, {"lightgaussian": score})
        return [PruneStage(self.config, pruner), DistillStage(self.config, Significance(**score))]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        codec = self.config.codec
        settings = {
            "ratio": codec.vq_ratio, "size": codec.codebook_size, "rows_per_code": codec.rows_per_code,
            "iterations": codec.vq_iterations, "batch": codec.vq_batch, "decay": codec.vq_decay,
            "reseed": codec.vq_reseed, "training": codec.vq_training,
        }  # fmt: skip
        encode_gaussians(self.plugins, codec.name, model, writer, **(settings if codec.name == "vectree" else {}))

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return decode_gaussians(self.plugins, reader)
