"""Hyper-parameters of 3DGS. Defaults are the paper's (the plan of the Splatwizard paper where they differ)."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar

from pydantic import Field
from sw_gaussians.choices import CodecChoice, Moved
from sw_gaussians.config import GaussianTraining
from sw_gaussians.fast.fused_adam import MIN_FUSED_GAUSSIANS
from sw_gaussians.sized import FILLING, Capped

from splatwizard_core.api import InputFile, SameResult
from sw_codecs.models.settings import QuantizedSettings

MODES = {"exact": "gaussians-exact", "quantized": "gaussians-quantized"}
"""Header value `mode` of a file (and `codec.mode` of 0.1 configs) -> codec."""


VIEWS_PER_GPU = 2
"""Views that each of several GPUs draws for an update: exchanging gradients then takes half as long per view."""
MOST_VIEWS = 8
"""Views in an update, at most: Adam's memory of gradients is then that of the last two."""


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
    batch: int = Field(
        1,
        ge=1,
        le=MOST_VIEWS,
        description="views whose gradients make one update; plans and steps are counted in views",
    )
    gpus: Annotated[int, SameResult()] = Field(
        1,
        ge=1,
        le=MOST_VIEWS,
        description="GPUs that train one model, each on its share of a batch; on a CPU: processes",
    )
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")

    def completed(self, plugins: Any, sources: Mapping[str, str]) -> Any:
        """Return this with a batch for its GPUs, unless one was given."""
        batch = self.batch if "batch" in sources or self.gpus == 1 else min(VIEWS_PER_GPU * self.gpus, MOST_VIEWS)
        return super(ThreeDGSConfig, self.model_copy(update={"batch": batch})).completed(plugins, sources)

    def translated(self, values: dict[str, Any]) -> dict[str, Any]:
        if "codec.mode" in values:
            mode = values.pop("codec.mode")
            values["codec.name"] = MODES.get(mode, f"gaussians-{mode}")
        return super().translated(values)
