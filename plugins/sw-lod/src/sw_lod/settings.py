"""Settings of the file in tiles."""

from pydantic import Field

from sw_codecs.models.settings import LatticeSettings


class TileSettings(LatticeSettings):
    """Grid and steps as of `gaussians-quantized`, and what comes first."""

    coarsest: int = Field(20, ge=2, le=1024, description="Gaussians that one of the first packet stands for")
    rows: int = Field(16_384, ge=8, le=2**31 - 1, description="Gaussians of a tile; more if there are over 256 tiles")
    layers: int = Field(3, ge=1, le=8, description="packets of a tile, its most significant Gaussians first")
