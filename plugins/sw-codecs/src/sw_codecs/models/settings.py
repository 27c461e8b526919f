"""Settings of the quantised file of Gaussians."""

from pydantic import Field

from sw_codecs.models.exchangeable import Exchangeable


class LatticeSettings(Exchangeable):
    """Grid of the positions, quantiser steps of all else, and what codes both."""

    position_bits: int = Field(18, ge=8, le=21, description="bits per axis of the position grid")
    dc_step: float = Field(
        0.02, ge=1e-6, le=1e3, description="quantiser step of SH band 0 (SH coefficient; 0.28 of it in colour)"
    )
    rest_step: float = Field(0.012, ge=1e-6, le=1e3, description="quantiser step of SH bands 1 to 3 (SH coefficient)")
    opacity_step: float = Field(0.08, ge=1e-6, le=1e3, description="quantiser step of the opacity logits")
    scale_step: float = Field(0.03, ge=1e-6, le=1e3, description="quantiser step of the log scales (0.03: 3 % in size)")
    quat_step: float = Field(0.007, ge=1e-6, le=0.5, description="quantiser step of the unit quaternion's x, y, z")


class QuantizedSettings(LatticeSettings):
    """Of the file in one piece or in packets."""

    precision_power: float = Field(
        0.0,
        ge=0,
        le=1,
        description="power of a Gaussian's weight in pictures by which its steps fall; 0: all have the same steps",
    )
    sh_basis: bool = Field(False, description="SH bands 1 to 3 in a basis of the scene's own, where that is smaller")
    prefixes: int = Field(
        0,
        ge=0,
        le=64,
        description="packets of Gaussians, the most significant first: the file can be cut after each; 0: one piece",
    )
