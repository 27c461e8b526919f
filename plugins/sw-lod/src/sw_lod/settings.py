"""Settings of the file in tiles."""

from pydantic import Field, field_validator

from sw_codecs.models.settings import LatticeSettings


class TileSettings(LatticeSettings):
    """Grid and steps as of `gaussians-quantized`, and what comes first."""

    coarsest: int = Field(5, ge=2, le=1024, description="Gaussians of the scene for each stand-in of the first packet")
    stand_ins: int = Field(20, ge=2, le=1024, description="Gaussians of the scene for each stand-in of a later layer")
    rows: int = Field(16_384, ge=8, le=2**31 - 1, description="Gaussians of a tile; more if there are many tiles")
    layers: int = Field(2, ge=1, le=8, description="packets of a tile, without finer ones")
    times: int = Field(
        7,
        ge=1,
        le=255,
        description="steps of Gaussians before they become finer, in quantiser steps; odd. 1: there is no finer",
    )
    raw: int = Field(5, ge=0, le=12, description="bits of each coordinate that come with the finer steps")

    @field_validator("times")
    @classmethod
    def _odd(cls, times: int) -> int:
        if times % 2 == 0:
            raise ValueError("an odd number: a coarse value is the middle one of those that it may become")
        return times

    @property
    def is_layered(self) -> bool:
        """Whether Gaussians come coarse first."""
        return self.times > 1 or self.raw > 0
