"""Hyper-parameters of HAC++. Defaults are those of the authors' experiments on Mip-NeRF 360."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, model_validator
from sw_gaussians.named_blocks import SWITCH, Choosing, Moved, OwnCodec

from splatwizard_core.api import Params
from sw_hac.config import FileSettings, HACLearningRates, HACParams, Phases, RateTerm


class Channels(Params):
    """The channel context: how features of an anchor predict one another."""

    kind: Literal["full", "tiny", "none"] = Field(
        "full",
        description="full: networks see the grid's prediction and the slices before; tiny: the slices alone, with "
        "smaller networks (authors: for NeRF Synthetic); none: the grid alone predicts, as in HAC",
    )
    slices: list[Annotated[int, Field(ge=1)]] = Field(
        [10, 10, 10, 10, 10], min_length=1, max_length=64, description="channels of the slices; they sum to feature_dim"
    )
    hidden: int = Field(40, ge=1, le=512, description="width of the networks of kind full")
    init_scale: float = Field(
        1.0, ge=0, description="second deviation of every channel before training, base steps (authors: as it comes)"
    )


class HACPlusLearningRates(HACLearningRates):
    """Adam step sizes; from `init` to `final` exponentially over `max_steps`."""

    masks_final: float | None = Field(  # type: ignore[assignment]
        None,
        gt=0,
        description="of the mask logits at `max_steps`, times the scene extent; unset: masks_by_rate times lambda",
    )
    masks_by_rate: float = Field(0.5, gt=0, description="final rate of the mask logits over lambda")
    masks_limit: float = Field(1.5e-3, gt=0, description="largest final rate of the mask logits that lambda gives")
    channel_init: float = Field(0.005, gt=0, description="of the channel networks at step 0")
    channel_final: float = Field(5e-4, gt=0, description="of the channel networks at `max_steps`")


class HACPlusPhases(Phases):
    """Steps at which training turns to noise, and to a rate."""

    rebound: int = Field(10_000, ge=1, description="step after which the box of the hash grid is fitted once more")
    entropy: int = Field(10_000, ge=1, description="after this step noise has predicted steps, and the rate counts")


class HACPlusRateTerm(RateTerm):
    """The rate term of the loss."""

    masks: float = Field(0.0, ge=0, description="weight of the mean soft mask, once the rate counts (HAC: 5e-4)")
    sample: float = Field(0.05, gt=0, le=1, description="share of all anchors whose bits are computed")
    anchor_gradient: bool = Field(
        True, description="whether the rate may switch off an anchor with all its bits; False: its offsets alone"
    )


class Codec(OwnCodec):
    """The file of HAC++, which no other codec can write."""

    name: Literal["hac-plus"] = Field("hac-plus", description="the file of HAC++")
    settings: FileSettings = Field(FileSettings(), description="settings of the file")


class HACPlusConfig(Choosing, HACParams):
    """Everything that can be set for HAC++."""

    OLDER: ClassVar[Mapping[str, Moved]] = {"graphs": Moved((), SWITCH)}
    ABSENT: ClassVar[Mapping[str, Any]] = {}

    bound_margin: Literal["hac", "extent", "none"] = Field(
        "hac", description="room around the anchors in the box of the hash grid; hac: as published; extent: 10 %"
    )
    lr: HACPlusLearningRates = Field(HACPlusLearningRates(), description="step sizes")
    phases: HACPlusPhases = Field(HACPlusPhases(), description="when training turns to noise, and to a rate")
    rate_term: HACPlusRateTerm = Field(HACPlusRateTerm(), description="rate term of the loss")
    channel: Channels = Field(Channels(), description="how features of an anchor predict one another")
    codec: Codec = Field(Codec(), description="what writes the file")

    @model_validator(mode="after")
    def _on_the_lattice(self) -> "HACPlusConfig":
        if self.growth.subvoxel:
            raise ValueError("growth.subvoxel would put anchors beside the lattice of voxels: leave it out")
        return self
