"""C3DGS: a trained 3DGS scene in codebooks of colours and shapes, fine-tuned through the quantizers of its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.method import GaussianMethod

from sw_c3dgs.config import C3DGSConfig
from sw_c3dgs.indexed import IndexedGaussians
from sw_c3dgs.model import SharedGaussians
from sw_c3dgs.presets import PRESETS, RATES
from sw_c3dgs.stage import FineTuneStage

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerWriter, SplatModel, Stage


class C3DGS(GaussianMethod):
    """Niedermayr, Stumpfegger, Westermann: Compressed 3D Gaussian Splatting for Accelerated Novel View Synthesis.

    Source: arXiv 2401.02436 (CVPR 2024), and facts about the authors' code.
    """

    name: ClassVar[str] = "c3dgs"
    version: ClassVar[int] = 1
    Config = C3DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r4"

    def stages(self) -> Sequence[Stage]:
        return [FineTuneStage(self.config)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write the values that were drawn in training; codecs other than `gaussians-indexed` get them gathered."""
        super().encode(IndexedGaussians(model.coded()) if isinstance(model, SharedGaussians) else model, writer)
