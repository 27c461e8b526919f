"""Settings of the file in tiles."""

from pydantic import Field

from sw_codecs.models.settings import LatticeSettings


class TileSettings(LatticeSettings):
    """Grid and steps as of `gaussians-quantized`, and what comes first."""

    coarsest: int = Field(20, ge=2, le=1024, description="Gaussians of the scene for each stand-in of the first packet")
    stand_ins: int = Field(25, ge=2, le=1024, description="Gaussians of the scene for each stand-in of a later layer")
    rows: int = Field(16_384, ge=8, le=2**31 - 1, description="Gaussians of a tile; more if there are many tiles")
    layers: int = Field(3, ge=1, le=8, description="packets of a tile")
