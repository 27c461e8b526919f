"""Trainings to a size: as many Gaussians as it holds, and a file that fills it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, runtime_checkable

from pydantic import Field

from splatwizard_core.api import ConfigError, parse_size
from sw_gaussians.byte_sizes import ByteSize
from sw_gaussians.choices import CodecChoice
from sw_gaussians.density.adc import GradientSettings
from sw_gaussians.density.choice import DensityChoice
from sw_gaussians.named_blocks import Exchangeable

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerWriter, GaussianModel, Method, PluginManager, Scene, SplatModel

SizedT = TypeVar("SizedT", bound="Sized")

FILLING = "gaussians-sized"
"""Codec that fills a size."""
BYTES = 12
"""Of one Gaussian in a file of a good mixture of number and precision, SH bands of degree 3 included."""
MOST_BYTES, HEADER = 236, 4_000
"""Bytes of one Gaussian as float32, SH bands of degree 3 included; of what stands before all of them, at most."""
LEAST_FILLED = 0.97
"""Share of the size below which a file is too small."""


@runtime_checkable
class Filling(Protocol):
    """A codec that chooses how another one writes a model of a scene."""

    def chosen(
        self, model: GaussianModel, method: str, raster: Mapping[str, Any], scene: Scene | None
    ) -> tuple[GaussianModel, CodecChoice]:
        """Return the Gaussians that are written, and the codec that does it."""
        ...


def fill(method: Method, model: SplatModel, writer: ContainerWriter) -> None:
    """Write a model by a method whose config has a `size`, in 97 to 100 % of it.

    method  whose `encode` writes the model where `size` is empty

    Steps between its rate points that share the training come first; then rows of the model go that the training
    views miss least: of a copy, whose `after_cut()` may bring the rest in step, from those of `rows_in_file()`.
    Where all is smaller than the size, that is written, and told. Raises UserInputError for a size that is too small.
    """
    method.plugins.gaussian_codecs.entry(FILLING).load()(method.plugins).fill(method, model, writer)


def hold_size(size: str, least: int, what: str) -> None:
    """Raise ConfigError before a training whose files cannot be as small.

    least   bytes that each of them has
    what    they are
    """
    if size and least > parse_size(size):
        raise ConfigError(
            f"size={size}: {what} alone have {least:,} bytes: ask for more, or make them smaller", key="size"
        )


class Sized(Exchangeable):
    """Base of configs of methods whose files may fill a size.

    FILLED_BY   codec that writes explicit Gaussians to a size; empty: the method's own files fill it, by `fill`
    REFUSES     option of `sw run` -> why the method does not take it, and what does the same
    """

    ENCODING = ("codec", "size")
    FILLED_BY: ClassVar[str] = ""
    REFUSES: ClassVar[Mapping[str, str]] = {
        "gaussians": "it starts from a trained scene: bound that one, as by --set pretrained.gaussians=N"
    }

    size: ByteSize = Field("", description="bytes of the file, never more: 5MB; empty: as the codec's settings say")

    def completed(self: SizedT, plugins: PluginManager, sources: Mapping[str, str]) -> SizedT:
        return super(Sized, self.model_copy(update=self.of_size(sources))).completed(plugins, sources)

    def of_size(self, sources: Mapping[str, str]) -> dict[str, Any]:
        """Return fields that follow from a size."""
        if not self.size or not self.FILLED_BY:
            return {}
        codec: CodecChoice = getattr(self, "codec")  # noqa: B009  # of the subclass
        source = sources.get("codec.name", "")
        if codec.name != self.FILLED_BY and source and not source.startswith(("preset ", "rate ", "data set ")):
            raise ConfigError(f"size={self.size} chooses the codec: leave out codec.name ({source})", key="codec.name")
        return {"codec": CodecChoice(name=self.FILLED_BY, settings={"size": self.size})}


class CappedBase(Sized):
    """The same for a method that grows its Gaussians by the stage of another one, whose values a key holds.

    BASE    that key: the other method's `gaussians` is what this one's stands for
    """

    BASE: ClassVar[str] = "base"
    REFUSES: ClassVar[Mapping[str, str]] = {}

    gaussians: int = Field(0, ge=0, le=10**9, description="most that density control makes; 0: as many as it finds")

    def of_size(self, sources: Mapping[str, str]) -> dict[str, Any]:
        base = {**getattr(self, self.BASE), **({"gaussians": self.gaussians} if self.gaussians else {})}
        return {**super().of_size(sources), self.BASE: base}


class Capped(Sized):
    """The same for a method that grows its Gaussians from a scene's points."""

    REFUSES: ClassVar[Mapping[str, str]] = {}

    gaussians: int = Field(0, ge=0, le=10**9, description="most that density control makes; 0: as many as it finds")

    def of_size(self, sources: Mapping[str, str]) -> dict[str, Any]:
        density: DensityChoice = getattr(self, "density")  # noqa: B009
        cap = self.gaussians or (max(parse_size(self.size) // BYTES, 1) if self.size and self.FILLED_BY else 0)
        if self.gaussians and self.size and LEAST_FILLED * parse_size(self.size) > MOST_BYTES * self.gaussians + HEADER:
            raise ConfigError(
                f"size={self.size}: {self.gaussians:,} Gaussians have no file as large, {MOST_BYTES} bytes each: "
                "raise gaussians, or leave it out",
                key="size",
            )
        changed = super().of_size(sources)
        if not cap or "density.settings.cap" in sources:
            return changed
        if density.name == "adc":  # the same control with a budget
            kept = {key: value for key, value in density.settings.items() if key in GradientSettings.model_fields}
            settings = {**kept, "score": "gradient", "cap": cap}
            return {**changed, "density": density.model_copy(update={"name": "budget", "settings": settings})}
        return {**changed, "density": density.model_copy(update={"settings": {**density.settings, "cap": cap}})}
