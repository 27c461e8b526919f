"""MesonGS: Post-training Compression of 3D Gaussians via Efficient Attribute Transformation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.sized import fill

from splatwizard_core.api import ConfigError, Method, SceneError
from sw_codecs.models.raht_gaussians import RahtGaussians
from sw_mesongs.config import MesonGSConfig
from sw_mesongs.presets import PRESETS, RATES
from sw_mesongs.stage import MesonGSStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage

CODEC = "raht"


class MesonGS(Method):
    """Xie, Zhang, Tang, Bai, Lu, Ge, Wang: MesonGS, ECCV 2024 (arXiv 2409.09756).

    1. PRUNE       by contribution to the training views and volume
    2. OCTREE      one Gaussian a voxel; a codebook for the SH bands 1 to 3
    3. FINE-TUNE   what comes out of the transform (RAHT of opacity, rotation as angles, SH band 0), of quantisation in
                   blocks, and of the codebook
    4. ENCODE      codec `raht`, with the ranges that training has seen
    """

    name: ClassVar[str] = "mesongs"
    version: ClassVar[int] = 1
    Config = MesonGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r4"  # c1, the authors' main results

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Raise SceneError: the stage starts from a trained scene, and there is no start from points."""
        raise SceneError(f"{self.name} starts from a trained 3dgs scene, not from points", path=scene.path)

    def stages(self) -> Sequence[Stage]:
        config: MesonGSConfig = self.config
        pruner = config.prune.load(self.plugins)
        if pruner.uses_statistics:
            raise ConfigError(
                f"prune.pruner '{config.prune.pruner}' reads gradient statistics; mesongs prunes before its first step",
                key="prune.pruner",
            )
        return [MesonGSStage(config, pruner)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, RahtGaussians) or model.grid is None:
            raise TypeError(f"{self.name} encodes what its stage has settled, not a {type(model).__name__}")
        if self.config.size:
            fill(self, model, writer)
            return
        writer.static["codec"] = CODEC
        self.plugins.gaussian_codecs.load(CODEC)(self.plugins).encode(model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        codec = reader.text("codec", choices=(CODEC,))
        return self.plugins.gaussian_codecs.load(codec)(self.plugins).decode(reader)
