"""Hyper-parameters of TrimGS on surfels: fine-tuned from a 2DGS scene, or trained from the start."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field
from sw_gaussians.choices import Choosing, CodecChoice
from sw_gaussians.older_keys import within
from sw_gaussians.sized import CappedBase
from sw_gaussians.surface_losses import NormalTerm

from splatwizard_core.api import Params
from sw_trimgs.config import Densify, Trimming, TuneConfig
from sw_trimgs.scale_split import Box


class SurfaceTuning(Params):
    """The losses of the surface, from the first step on."""

    depth_ratio: float | None = Field(
        None,
        ge=0,
        le=1,
        description="depth of the surface: 0 expected, 1 median; unset: that of the scene before, or 0",
    )
    lambda_dist: float = Field(100.0, ge=0, description="weight of the distortion, for the authors' scene scale")
    lambda_normal: float = Field(0.05, ge=0, description="weight of the normal consistency")
    normal_term: NormalTerm = Field(
        "code", description="form of the normal loss: of the authors' code, or paper: an empty pixel costs nothing"
    )
    edge_threshold: float = Field(
        0.03, ge=0, description="pixels where the depth changes by more do not count, world units a pixel; 0: all do"
    )
    erosion: int = Field(1, ge=0, description="pixels around those that do not count either")


class Trim2DGSConfig(TuneConfig):
    """Everything that can be set for TrimGS on surfels."""

    densify: Densify = Field(Densify(factor=0.5, size_px=20), description="density control")
    surface: SurfaceTuning = Field(SurfaceTuning(), description="losses of the surface")
    drop_masked: bool = Field(
        False, description="first drop what lies outside the mask of a view that it is seen in (DTU)"
    )


class ScratchSplit(Params):
    """The scale split beside 2DGS' own density control, at its steps."""

    start: int = Field(600, ge=0, description="first scale split")
    stop: int = Field(15_000, ge=0, description="no scale split from this step on")
    interval: int = Field(100, ge=1, description="steps between two")
    percent_dense: float = Field(0.01, gt=0, description="scale above it, times factor and extent, is split")
    factor: float = Field(0.3, gt=0, description="k of the scale split")
    box: Box = Field("own", description="room around the cameras where it splits; xx: as deep as wide, authors' code")


class ScratchTrimming(Trimming):
    """The removals while the scene densifies."""

    after: int = Field(500, ge=0, description="no trim up to this step")
    interval: int = Field(300, ge=1, description="steps between trims")
    stop: int = Field(15_000, ge=0, description="no trim from this step on")


class ScratchSurface(Params):
    """The losses of the surface; that of the distortion is 2DGS' own."""

    depth_ratio: float | None = Field(None, ge=0, le=1, description="as of 2dgs; unset: by data set")
    lambda_dist: float = Field(100.0, ge=0, description="weight of the distortion, for the authors' scene scale")
    lambda_normal: float = Field(0.05, ge=0, description="weight of the normal consistency")
    normal_term: NormalTerm = Field(
        "code", description="form of the normal loss: of the authors' code, or paper: an empty pixel costs nothing"
    )
    normal_after: int = Field(7_000, ge=0, description="last step without the normal loss")
    edge_threshold: float = Field(
        0.03, ge=0, description="pixels where the depth changes by more do not count, world units a pixel; 0: all do"
    )
    erosion: int = Field(1, ge=0, description="pixels around those that do not count either")


class ScratchConfig(CappedBase, Choosing):
    """Everything that can be set for TrimGS on surfels that are trained from the start; all else is 2DGS' `base`."""

    FULL_ITERATIONS: ClassVar[int] = 30_000

    densify: ScratchSplit = Field(ScratchSplit(), description="the scale split")
    trim: ScratchTrimming = Field(ScratchTrimming(), description="removal of what contributes least")
    surface: ScratchSurface = Field(ScratchSurface(), description="losses of the surface")
    base: dict[str, Any] = Field(
        {},
        description="values of 2dgs by its keys (base.density.settings.interval=50), its preset (base.preset)",
    )
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")

    def translated(self, values: dict[str, Any]) -> dict[str, Any]:
        return within(values, "base.")
