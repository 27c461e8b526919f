"""Hyper-parameters of CAT-3DGS. Defaults are those of the authors' code for Mip-NeRF 360."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field
from sw_anchors.lattice import Margin
from sw_anchors.params import CodedAnchorLearningRates, CodedAnchorParams
from sw_gaussians.named_blocks import SWITCH, Choosing, Moved, OwnCodec

from splatwizard_core.api import Params

FULL_RUN = 40_000
"""Steps of the published plan."""


class Phases(Params):
    """First steps of the phases of training."""

    quantize: int = Field(3_000, ge=1, description="attributes get noise of fixed steps, masks a regulariser")
    triplane: int = Field(
        10_000, ge=1, description="the triplane is set up; one step later noise of predicted steps, and the rate"
    )
    warmup: int = Field(15_000, ge=1, description="planes are rounded one step later; their spatial models train alone")
    scene: int = Field(16_000, ge=1, description="everything but the planes trains")
    planes: int = Field(19_000, ge=1, description="everything trains")
    official_warmup: bool = Field(
        False,
        description="spatial models stay as they are during the warm-up, as in the authors' code: it does nothing",
    )
    rebound: bool = Field(True, description="fit the lattice of positions again at the warm-up, when growth is over")


class Steps(Params):
    """Quantiser steps that the predicted ones multiply by 0.1 to 2.1; that of the features is 1."""

    scales: float = Field(0.001, gt=0, description="base step of the scales, world units")
    offsets: float = Field(0.2, gt=0, description="base step of the offsets, in units of the scales")


class Context(Params):
    """Sizes of the models that predict attributes."""

    channels: int = Field(72, ge=1, le=512, description="channels of each plane")
    multiples: list[int] = Field(
        [1, 2], min_length=1, max_length=4, description="resolutions of the scales over the base resolution; up to 16"
    )
    anchors_per_cell: float = Field(
        36.0, gt=0, description="the base resolution is sqrt(anchors / this) when the triplane is set up"
    )
    hidden: int = Field(100, ge=1, le=512, description="width of the context network")
    slices: list[int] = Field(
        [5, 10, 15, 20], min_length=1, max_length=64, description="slices of the features; sums to feature_dim"
    )
    slice_hidden: int = Field(100, ge=1, le=512, description="width of the networks of the slices")
    units: Literal["values", "steps"] = Field(
        "values", description="what the network predicts scales and offsets in; steps learns faster, same file"
    )
    start: Literal["network", "statistics"] = Field(
        "network",
        description="network: all of it at random, as published; statistics: at mean and deviation of each column of "
        "the anchors at the set-up, slices adding nothing",
    )
    refine: bool = Field(False, description="also predict scales and offsets better from all features")
    neighbors: int = Field(50, ge=1, description="neighbours that decide whether an anchor is an outlier")
    contamination: float = Field(0.05, ge=0, lt=1, description="share of anchors that the triplane's axes ignore")


class RateTerm(Params):
    """The rate term and the masks."""

    lambda_: float = Field(0.002, ge=0, description="weight of the bits per number of an anchor")
    scale: float = Field(
        1.0, ge=0, description="multiplies lambda_, whose values are meant for scenes of some 100,000 anchors"
    )
    triplane: float = Field(10.0, ge=0, description="weight of the bits of the planes, times that of an anchor's bits")
    sample: float = Field(
        0.05, gt=0, le=1, description="share of the visible anchors whose bits are computed each step"
    )
    triplane_sample: float = Field(
        1.0, gt=0, le=1, description="share of the channels whose bits are computed each step"
    )
    mask_floor: float = Field(1e-3, ge=0, description="least weight of the mean sigmoid of the mask logits")
    mask_factor: float = Field(0.3, ge=0, description="that weight over lambda_ * scale, where it is more")
    scale_floor: float = Field(
        0.0,
        ge=0,
        le=1,
        description="least deviation of a number in training, in its steps; 0.05: that of the coder, with a gradient "
        "from below; 0: 1e-9 as published, where a column that starts below 0 for all anchors never learns",
    )
    view_factor: float = Field(1.0, gt=0, description="weight of a mask of an anchor seen as often as the average one")

    @property
    def weight(self) -> float:
        """Weight of the bits per number."""
        return self.lambda_ * self.scale


class ContextLearningRates(Params):
    """Adam step sizes of the context, from when they start; they decay over lr.max_steps."""

    init: float = Field(0.008, gt=0, description="of context network, slices, planes (once trained) at the start")
    final: float = Field(5e-5, gt=0, description="of those after `lr.max_steps`")
    planes_init: float = Field(0.0075, gt=0, description="of the planes at the step that sets them up")
    spatial_init: float = Field(0.005, gt=0, description="of the spatial models before the warm-up")


class FileSettings(Params):
    """Settings of the file."""

    DEFAULTS: ClassVar[int] = 1

    mode: Literal["exact", "float"] = Field(
        "exact", description="exact: integers, decodes anywhere; float: only where networks give the same floats"
    )
    weights: Literal["float32", "float16"] = Field("float16", description="how weights of networks are stored")


class Codec(OwnCodec):
    """The file of CAT-3DGS, which no other codec can write."""

    name: Literal["cat-3dgs"] = Field("cat-3dgs", description="the file of CAT-3DGS")
    settings: FileSettings = Field(FileSettings(), description="settings of the file")


class CatConfig(Choosing, CodedAnchorParams):
    """Everything that can be set for CAT-3DGS."""

    FULL_ITERATIONS: ClassVar[int] = FULL_RUN
    OLDER: ClassVar[Mapping[str, Moved]] = {
        f"codec.{name}": Moved((f"codec.settings.{name}",)) for name in FileSettings.model_fields
    } | {"graphs": Moved((), SWITCH)}

    iterations: int = Field(FULL_RUN, ge=1, description="steps; plans keep their ranges, tasks past the end never fire")
    bound_margin: Literal["hac", "extent", "none"] = Field(
        "none", description="room around the anchors on their 16-bit lattice; hac: as HAC has it; extent: 10 %"
    )
    lr: CodedAnchorLearningRates = Field(CodedAnchorLearningRates(max_steps=FULL_RUN), description="step sizes")
    context_lr: ContextLearningRates = Field(ContextLearningRates(), description="step sizes of the context")
    phases: Phases = Field(Phases(), description="what is trained when")
    steps: Steps = Field(Steps(), description="base steps of the quantisers")
    context: Context = Field(Context(), description="the models that predict attributes")
    rate_term: RateTerm = Field(RateTerm(), description="rate term and masks")
    size: str = Field("", description="bytes of the file at most: 5MB; lambda is led to it; empty: as lambda has it")
    codec: Codec = Field(Codec(), description="what writes the file")

    @property
    def margin(self) -> Margin:
        """Margin of the lattice in the words of sw_anchors."""
        return "origin" if self.bound_margin == "hac" else self.bound_margin
