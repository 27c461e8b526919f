"""Hyper-parameters of 3DGS. Defaults are the paper's (the plan of the Splatwizard paper where they differ)."""

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import Field
from sw_gaussians.choices import CodecChoice, Moved
from sw_gaussians.config import GaussianTraining
from sw_gaussians.fast.fused_adam import MIN_FUSED_GAUSSIANS
from sw_gaussians.sized import FILLING, Capped

from splatwizard_core.api import InputFile
from sw_codecs.models.settings import QuantizedSettings

MODES = {"exact": "gaussians-exact", "quantized": "gaussians-quantized"}
"""Header value `mode` of a file (and `codec.mode` of 0.1 configs) -> codec."""


class ThreeDGSConfig(Capped, GaussianTraining):
    """Configuration of 3DGS."""

    FILLED_BY: ClassVar[str] = FILLING
    OLDER: ClassVar[Mapping[str, Moved]] = {
        f"codec.{name}": Moved((f"codec.settings.{name}",), field.default, MODES["quantized"])
        for name, field in QuantizedSettings.model_fields.items()
        if name not in QuantizedSettings.USUAL
    }

    sh_degree: int = Field(3, ge=0, le=3, description="highest degree of the spherical harmonics")
    init: InputFile = Field(
        "", description="a .ply to start from, with all its SH bands active; empty: the scene's points"
    )
    fused_updates: bool | None = Field(
        None,
        description="on CUDA, update spherical harmonics in the backward pass, equal but for rounding; None: from "
        f"{MIN_FUSED_GAUSSIANS:,} Gaussians on, where it is faster",
    )
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")

    def translated(self, values: dict[str, Any]) -> dict[str, Any]:
        if "codec.mode" in values:
            mode = values.pop("codec.mode")
            values["codec.name"] = MODES.get(mode, f"gaussians-{mode}")
        return super().translated(values)
