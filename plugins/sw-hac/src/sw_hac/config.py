"""Hyper-parameters of HAC. Defaults are those of the paper's experiments on Mip-NeRF 360."""

from collections.abc import Mapping
from typing import Annotated, ClassVar, Literal

from pydantic import Field
from sw_anchors.lattice import Margin
from sw_anchors.params import CodedAnchorLearningRates, CodedAnchorParams
from sw_gaussians.named_blocks import SWITCH, Choosing, Moved, OwnCodec

from splatwizard_core.api import Params

Resolution = Annotated[int, Field(ge=3, le=4096)]


SMALLEST_STEP = 1 / 64
"""Smallest predicted step over its base step, where the file's table of steps ends. Paper: 1 + tanh t, down to 0."""


class GridSettings(Params):
    """The hash grid and the network that reads it."""

    space: list[Resolution] = Field(
        [18, 24, 33, 44, 59, 80, 108, 148, 201, 275, 376, 514],
        min_length=1,
        max_length=32,
        description="vertices an axis of the levels over space; the outer two are not used",
    )
    planes: list[Resolution] = Field(
        [130, 258, 514, 1026],
        min_length=1,
        max_length=32,
        description="vertices an axis of the levels over each coordinate plane",
    )
    features: int = Field(4, ge=1, le=16, description="bits of a vertex")
    log2_space: int = Field(13, ge=3, le=22, description="a level over space has at most 2^this entries")
    log2_planes: int = Field(15, ge=3, le=22, description="a level over a plane has at most 2^this entries")
    hidden: int = Field(100, ge=1, le=256, description="width of the network that predicts distributions")


class HACLearningRates(CodedAnchorLearningRates):
    """Adam step sizes; from `init` to `final` exponentially over `max_steps`."""

    grid_init: float = Field(0.005, gt=0, description="of the hash grid at step 0")
    grid_final: float = Field(1e-5, gt=0, description="of the hash grid at `max_steps`")
    mlp_grid_init: float = Field(0.005, gt=0, description="of the network behind the grid at step 0")
    mlp_grid_final: float = Field(1e-5, gt=0, description="of the network behind the grid at `max_steps`")


class Phases(Params):
    """Steps at which training turns to noise, and to a rate."""

    quantized: int = Field(3_000, ge=1, description="after this step values get noise of fixed steps")
    rebound: int = Field(10_000, ge=1, description="step after which the 16-bit lattice is fitted once more")
    entropy: int = Field(10_001, ge=1, description="after this step noise has predicted steps, and the rate counts")


class RateTerm(Params):
    """The rate term of the loss."""

    weight: float = Field(0.001, ge=0, description="lambda: weight of the bits per number")
    masks: float = Field(5e-4, ge=0, description="weight of the mean soft mask, once the rate counts")
    sample: float = Field(0.05, gt=0, le=1, description="share of the visible anchors whose bits are computed")
    scale_floor: float = Field(
        0.0,
        ge=0,
        le=1,
        description="least deviation of a number in training, in its steps; 0.05: that of the coder, with a gradient "
        "from below; 0: 1e-9 as published, from where no deviation learns",
    )
    start: Literal["network", "statistics"] = Field(
        "network",
        description="first prediction: the network's, as published, or mean and deviation of the values at that step",
    )
    units: Literal["values", "steps"] = Field(
        "values", description="the network predicts values, as published, or multiples of the base steps"
    )


class Steps(Params):
    """Quantiser steps before they are predicted (Q0); a predicted one is at most twice as large."""

    features: float = Field(1.0, ge=1e-6, le=1e3, description="of the anchor features")
    scales: float = Field(0.001, ge=1e-6, le=1e3, description="of the scales, world units")
    offsets: float = Field(0.2, ge=1e-6, le=1e3, description="of the offsets, in units of the first three scales")

    @property
    def triple(self) -> tuple[float, float, float]:
        """Base steps of features, scales and offsets."""
        return self.features, self.scales, self.offsets


class FileSettings(Params):
    """Settings of the file."""

    DEFAULTS: ClassVar[int] = 1
    mode: Literal["exact", "float"] = Field(
        "exact", description="exact: decodes on any machine; float: as published, decodes on this one"
    )
    weights: Literal["float32", "float16"] = Field("float16", description="type of the networks' weights")


class HACParams(CodedAnchorParams):
    """Hyper-parameters of a method whose anchors a hash grid predicts, to be subclassed."""

    bound_margin: Literal["hac", "extent", "none"] = Field(
        "hac", description="room around the anchors on their 16-bit lattice; hac: as published; extent: 10 %"
    )
    grid: GridSettings = Field(GridSettings(), description="hash grid and its network")
    lr: HACLearningRates = Field(HACLearningRates(), description="step sizes")
    phases: Phases = Field(Phases(), description="when training turns to noise, and to a rate")
    rate_term: RateTerm = Field(RateTerm(), description="rate term of the loss")
    steps: Steps = Field(Steps(), description="quantiser steps before they are predicted")
    size: str = Field("", description="bytes of the file at most: 5MB; lambda is led to it; empty: as lambda has it")

    @property
    def margin(self) -> Margin:
        """Margin of the lattice in the words of `lattice.bounds_of`."""
        return "origin" if self.bound_margin == "hac" else self.bound_margin


class Codec(OwnCodec):
    """The file of HAC, which no other codec can write."""

    name: Literal["hac"] = Field("hac", description="the file of HAC")
    settings: FileSettings = Field(FileSettings(), description="settings of the file")


class HACConfig(Choosing, HACParams):
    """Everything that can be set for HAC."""

    OLDER: ClassVar[Mapping[str, Moved]] = {
        f"codec.{name}": Moved((f"codec.settings.{name}",)) for name in FileSettings.model_fields
    } | {"graphs": Moved((), SWITCH)}

    codec: Codec = Field(Codec(), description="what writes the file")
