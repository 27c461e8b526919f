"""Formats as methods: a trained 3DGS scene, encoded, so that tables show them beside the papers' codecs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pydantic import Field
from sw_gaussians.choices import Choosing, CodecChoice
from sw_gaussians.method import GaussianMethod
from sw_gaussians.sized import Sized

from splatwizard_core.api import Scene, SplatModel, SplatOptimizer, Stage


class TrainedScene(Stage):
    """The trained scene as it is: no step."""

    name = "trained scene"
    iterations = 0  # a property of Stage, here a constant
    starts_from = "3dgs"

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        """Return one that updates nothing: a stage has an optimizer, also without a step."""
        return SplatOptimizer(model, [])


class FormatConfig(Sized, Choosing):
    """Base of the configs: nothing is trained."""

    iterations: int = Field(0, ge=0, description="without effect: nothing is trained after the scene of 3dgs")


class FormatMethod(GaussianMethod):
    """Base: encodes a trained 3DGS scene by the codec of its own name."""

    version: ClassVar[int] = 1

    def stages(self) -> Sequence[Stage]:
        return [TrainedScene(self.config)]


class SpzConfig(FormatConfig):
    """Everything that can be set for .spz."""

    codec: CodecChoice = Field(CodecChoice(name="spz"), description="what writes the file")


class Spz(FormatMethod):
    """The .spz of Niantic: rate points differ in the bits of the spherical harmonics, r2 is what its tools write."""

    name: ClassVar[str] = "spz"
    Config = SpzConfig
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "r1": {"codec.settings.sh1_bits": 4, "codec.settings.sh_bits": 2},
        "r2": {"codec.settings.sh1_bits": 5, "codec.settings.sh_bits": 4},
        "r3": {"codec.settings.sh1_bits": 8, "codec.settings.sh_bits": 8},
    }
    DEFAULT_RATE: ClassVar[str] = "r2"


class SogConfig(FormatConfig):
    """Everything that can be set for .sog."""

    codec: CodecChoice = Field(CodecChoice(name="sog"), description="what writes the file")


class Sog(FormatMethod):
    """The .sog of PlayCanvas: rate points differ in the palette of the spherical harmonics, r2 is its tools'."""

    name: ClassVar[str] = "sog"
    Config = SogConfig
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        "r1": {"codec.settings.palette": 256},
        "r2": {"codec.settings.palette": None},
        "r3": {"codec.settings.palette": 65_536},
    }
    DEFAULT_RATE: ClassVar[str] = "r2"


class SplatConfig(FormatConfig):
    """Everything that can be set for .splat."""

    codec: CodecChoice = Field(CodecChoice(name="splat"), description="what writes the file")


class Splat(FormatMethod):
    """The .splat of antimatter15; it has no spherical harmonics, and nothing to set."""

    name: ClassVar[str] = "splat"
    Config = SplatConfig


class CompressedPlyConfig(FormatConfig):
    """Everything that can be set for compressed .ply."""

    codec: CodecChoice = Field(CodecChoice(name="compressed-ply"), description="what writes the file")


class CompressedPly(FormatMethod):
    """The compressed .ply of PlayCanvas, as SuperSplat writes it; nothing to set."""

    name: ClassVar[str] = "compressed-ply"
    Config = CompressedPlyConfig


class GscQuantConfig(FormatConfig):
    """Everything that can be set for gsc-quant."""

    codec: CodecChoice = Field(CodecChoice(name="gsc-quant"), description="what writes the file")


class GscQuant(FormatMethod):
    """The quantiser of the MPEG GSC exploration, and our lossless coder: an anchor; r5 has the exploration's bits."""

    name: ClassVar[str] = "gsc-quant"
    Config = GscQuantConfig
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = {
        f"r{i}": {"codec.settings.position_bits": position, "codec.settings.bits": bits}
        for i, (position, bits) in enumerate(((14, 6), (15, 7), (16, 8), (17, 10), (18, 12)), 1)
    }
    DEFAULT_RATE: ClassVar[str] = "r5"
