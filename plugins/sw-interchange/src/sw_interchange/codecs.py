"""Files of other programs as codecs of Gaussian models: the file of a method carries theirs, byte for byte.

Section `file` is what the other program would read. `sw export` of the file in that format need not give the same
bytes: what was decoded is coded a second time.
"""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from pydantic import BaseModel, Field, ValidationInfo, field_validator
from sw_gaussians.surfels import refuse_surfels

from splatwizard_core.api import BitstreamError, GaussianModel, Params, UserInputError

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, PluginManager

log = logging.getLogger(__name__)

SECTION = "file"
RAW_BYTES = 4 * 59
"""Of a decoded Gaussian at SH degree 3, the most that a format here holds."""


class FormatCodec:
    """Base: a GaussianModel as the bytes of a format of sw-interchange.

    FORMAT      its name there
    MAX_DEGREE  of the spherical harmonics that it holds; higher bands are dropped

    Lossy in every format, and the Gaussians may come back in another order. An empty model has no section.
    """

    FORMAT: ClassVar[str]
    MAX_DEGREE: ClassVar[int] = 3
    Settings: ClassVar[type[BaseModel]] = Params

    def __init__(self, plugins: PluginManager, **settings: Any) -> None:
        self.settings = self.Settings(**settings)

    def options(self) -> dict[str, Any]:
        """Return the options of the format's writer."""
        return self.settings.model_dump()

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        """Write section `file`. Raises UserInputError for surfels, ValueError for what the format cannot hold."""
        from sw_interchange import encode, from_gaussians

        refuse_surfels(model, f"codec {self.FORMAT}")
        degree = min(model.active_sh_degree, self.MAX_DEGREE)
        writer.raster["sh_degree"] = degree
        count = 0
        if model.num_rows:
            try:
                scene = from_gaussians(model)
                scene.antialiased = writer.raster.get("antialias") is True
                data, report = encode(scene, self.FORMAT, **self.options())
            except UserInputError as error:
                raise ValueError(str(error)) from error
            for line in report.notices():
                log.warning("%s: %s", self.FORMAT, line)
            count = report.num_gaussians
            writer.add(SECTION, data)
        writer.static["num_gaussians"] = count
        writer.static["sh_degree"] = degree

    def decode(self, reader: ContainerReader) -> GaussianModel:
        """Return the model. Raises BitstreamError."""
        from sw_interchange import Limits, decode, to_gaussians

        count = reader.integer("num_gaussians", low=0, high=2**32 - 1)
        degree = reader.integer("sh_degree", low=0, high=self.MAX_DEGREE)
        reader.allow(RAW_BYTES * count, f"{count:,} Gaussians")
        if count == 0:
            sizes = ((0, 3), (0, 1, 3), (0, (degree + 1) ** 2 - 1, 3), (0,), (0, 3), (0, 4))
            return GaussianModel.from_tensors(*(torch.zeros(size) for size in sizes))
        with reader.decoding(SECTION) as data:
            limits = Limits(max_gaussians=count, max_output_bytes=16 * RAW_BYTES * count + (1 << 20))
            try:
                scene = decode(data, self.FORMAT, name=f"{reader.name}: section '{SECTION}'", limits=limits)
            except BitstreamError:
                raise
            except UserInputError as error:
                raise BitstreamError(str(error), section=SECTION) from error
            if scene.num_gaussians != count or scene.sh_degree > degree:
                raise BitstreamError(
                    f"{reader.name}: section '{SECTION}' holds {scene.num_gaussians:,} Gaussians of SH degree "
                    f"{scene.sh_degree}, the header says {count:,} of degree {degree}",
                    section=SECTION,
                )
            return to_gaussians(scene)


class SpzSettings(Params):
    """Settings of .spz."""

    version: Literal[3, 4] = Field(3, description="3: gzip, which most programs read; 4: zstd, quicker")
    sh1_bits: int = Field(5, ge=1, le=8, description="bits of an SH coefficient of band 1")
    sh_bits: int = Field(4, ge=1, le=8, description="bits of an SH coefficient of bands 2 and 3")
    fractional_bits: int = Field(
        12, ge=0, le=24, description="bits of a coordinate below one world unit; 24 in all, with the sign"
    )
    level: int | None = Field(
        None,
        ge=1,
        le=22,
        description="of the compressor, gzip up to 9; none: that of Niantic's tools, 6 of gzip, 12 of zstd",
    )

    @field_validator("level")
    @classmethod
    def _known(cls, value: int | None, others: ValidationInfo) -> int | None:
        if value is not None and value > 9 and others.data.get("version") != 4:
            raise ValueError("at most 9, except with version 4")
        return value


class SpzCodec(FormatCodec):
    """.spz of Niantic: fixed-point positions, 8-bit colours, opacities and scales, smallest-three rotations."""

    FORMAT = "spz"
    Settings = SpzSettings

    def options(self) -> dict[str, Any]:
        """Return the options of the writer, which is quicker and coarser by default than Niantic's tools are."""
        found = super().options()
        return found | {"level": found["level"] or (12 if found["version"] == 4 else 6)}


class SogSettings(Params):
    """Settings of .sog."""

    palette: int | None = Field(
        None,
        ge=1,
        le=65_536,
        description="vectors of the SH palette; none: by the number of Gaussians, as its authors do",
    )
    iterations: int = Field(10, ge=1, le=100, description="of the k-means that finds the palette")
    seed: int = Field(0, ge=0, description="of the start of that")
    effort: int = Field(4, ge=0, le=6, description="of the lossless WebP encoder: 0 quick, 6 small")


class SogCodec(FormatCodec):
    """.sog of PlayCanvas: 16-bit positions on a log scale, codebooks of 256, a palette of SH; WebP images."""

    FORMAT = "sog"
    Settings = SogSettings


class SplatCodec(FormatCodec):
    """.splat of antimatter15: 32 bytes per Gaussian, float32 positions and scales, one colour."""

    FORMAT = "splat"
    MAX_DEGREE = 0


class CompressedPlyCodec(FormatCodec):
    """Compressed .ply of PlayCanvas: 16 bytes per Gaussian in chunks of 256, and 8-bit spherical harmonics."""

    FORMAT = "compressed-ply"
