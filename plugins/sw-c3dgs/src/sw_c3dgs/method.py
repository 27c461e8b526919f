"""C3DGS: a trained 3DGS scene in codebooks of colours and shapes, fine-tuned through the quantizers of its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.api import ConfigError, GaussianModel, Method, create_method
from sw_c3dgs.config import C3DGSConfig
from sw_c3dgs.indexed import IndexedGaussians
from sw_c3dgs.model import SharedGaussians
from sw_c3dgs.presets import PRESETS, RATES
from sw_c3dgs.stage import FineTuneStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class C3DGS(Method):
    """Niedermayr, Stumpfegger, Westermann: Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis.

    Source: arXiv 2401.02436 (CVPR 2024), and facts about the authors' code.
    """

    name: ClassVar[str] = "c3dgs"
    version: ClassVar[int] = 1
    Config = C3DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r4"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Return the start of a 3DGS scene; the stage starts from a finished one instead."""
        return create_method(self.plugins, "3dgs").create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        name, known = self.config.codec.name, self.plugins.gaussian_codecs
        if name not in known:
            raise ConfigError(
                f"no codec for Gaussians is called '{name}'; installed: {', '.join(known.names)}", key="codec.name"
            )
        return [FineTuneStage(self.config)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write the values that were drawn in training; other codecs than the default one get them gathered."""
        if isinstance(model, SharedGaussians):
            model = IndexedGaussians(model.coded())
        if not isinstance(model, GaussianModel):
            raise TypeError(f"{self.name} encodes Gaussians, not a {type(model).__name__}")
        codec = self.config.codec
        writer.static["codec"] = codec.name
        self.plugins.gaussian_codecs.load(codec.name)(self.plugins, **codec.settings).encode(model, writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        codecs = self.plugins.gaussian_codecs
        return codecs.load(reader.text("codec", choices=codecs.names))(self.plugins).decode(reader)
