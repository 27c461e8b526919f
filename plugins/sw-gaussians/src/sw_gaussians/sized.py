"""Trainings to a size: as many Gaussians as it holds, and a codec that fills it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

from pydantic import Field

from splatwizard_core.api import ConfigError, parse_size
from sw_gaussians.byte_sizes import ByteSize
from sw_gaussians.choices import CodecChoice
from sw_gaussians.density.adc import GradientSettings
from sw_gaussians.density.choice import DensityChoice
from sw_gaussians.named_blocks import Exchangeable

if TYPE_CHECKING:
    from splatwizard_core.api import GaussianModel, PluginManager, Scene

SizedT = TypeVar("SizedT", bound="Sized")

FILLING = "gaussians-sized"
"""Codec that fills a size."""
BYTES = 12
"""Of one Gaussian in a file of a good mixture of number and precision, SH bands of degree 3 included."""


@runtime_checkable
class Filling(Protocol):
    """A codec that chooses how another one writes a model of a scene."""

    def chosen(
        self, model: GaussianModel, method: str, raster: Mapping[str, Any], scene: Scene | None
    ) -> tuple[GaussianModel, CodecChoice]:
        """Return the Gaussians that are written, and the codec that does it."""
        ...


class Sized(Exchangeable):
    """Base of configs of methods whose explicit Gaussians may be written to a size."""

    ENCODING = ("codec", "size")

    size: ByteSize = Field("", description="bytes of the file, never more: 5MB; empty: as the codec's settings say")

    def completed(self: SizedT, plugins: PluginManager, sources: Mapping[str, str]) -> SizedT:
        return super(Sized, self.model_copy(update=self.of_size(sources))).completed(plugins, sources)

    def of_size(self, sources: Mapping[str, str]) -> dict[str, Any]:
        """Return fields that follow from a size."""
        if not self.size:
            return {}
        codec: CodecChoice = getattr(self, "codec")  # noqa: B009  # of the subclass
        source = sources.get("codec.name", "")
        if codec.name != FILLING and source and not source.startswith(("preset ", "rate ", "data set ")):
            raise ConfigError(f"size={self.size} chooses the codec: leave out codec.name ({source})", key="codec.name")
        return {"codec": CodecChoice(name=FILLING, settings={"size": self.size})}


class Capped(Sized):
    """The same for a method that grows its Gaussians from a scene's points."""

    gaussians: int = Field(
        0, ge=0, le=10**9, description="most that density control makes; 0: as its settings say, or as `size` holds"
    )

    def of_size(self, sources: Mapping[str, str]) -> dict[str, Any]:
        density: DensityChoice = getattr(self, "density")  # noqa: B009
        cap = self.gaussians or (max(parse_size(self.size) // BYTES, 1) if self.size else 0)
        changed = super().of_size(sources)
        if not cap or "density.settings.cap" in sources:
            return changed
        if density.name == "adc":  # the same control with a budget
            kept = {key: value for key, value in density.settings.items() if key in GradientSettings.model_fields}
            settings = {**kept, "score": "gradient", "cap": cap}
            return {**changed, "density": density.model_copy(update={"name": "budget", "settings": settings})}
        return {**changed, "density": density.model_copy(update={"settings": {**density.settings, "cap": cap}})}
