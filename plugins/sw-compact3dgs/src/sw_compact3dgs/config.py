"""Hyper-parameters of Compact3DGS. Defaults are those of the authors' code for real scenes."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field
from sw_gaussians.config import GaussianTraining, Loss
from sw_gaussians.config import LearningRates as GaussianRates
from sw_gaussians.density.choice import DensityChoice
from sw_gaussians.named_blocks import Choosing, Moved, OwnCodec
from sw_gaussians.older_keys import DENSIFY
from sw_gaussians.pictures import Pictures
from sw_gaussians.sized import Capped

from splatwizard_core.api import Params


class LearningRates(Params):
    """Adam step sizes of the Gaussians; those of mask, grid and codebooks stand beside what they train."""

    position_init: float = Field(1.6e-4, gt=0, description="of the means at step 0, times the scene extent")
    position_final: float = Field(1.6e-6, gt=0, description="of the means at step `max_steps`, times the scene extent")
    max_steps: int = Field(30_000, ge=1, description="steps over which the position rate decays")
    opacity: float = Field(0.05, ge=0, description="of the opacity logits")
    scales: float = Field(5e-3, ge=0, description="of the log scales")
    quats: float = Field(1e-3, ge=0, description="of the quaternions")


class Mask(Params):
    """The learned volume mask."""

    init: float = Field(1.0, ge=-4, le=10, description="logit at the start; sigmoid(1) = 0.731")
    threshold: float = Field(0.01, gt=0, lt=1, description="a Gaussian is on where the sigmoid is above this")
    lr: float = Field(0.01, ge=0, description="Adam step size of the logits")
    weight: float = Field(5e-4, ge=0, description="lambda_m: weight of the mean sigmoid in the loss")
    factor: float = Field(1.0, ge=0, description="multiplies `mask.weight`: what the rate points set")
    interval: int = Field(1_000, ge=1, description="steps between removals once densification is over")


class Grid(Params):
    """The hash grid that colours come from."""

    levels: int = Field(16, ge=1, le=32, description="resolutions")
    features: int = Field(2, ge=1, le=8, description="numbers of an entry")
    coarsest: int = Field(16, ge=2, le=1024, description="vertices an axis of the first level")
    growth: float = Field(1.447, ge=1, le=4, description="ratio of the resolutions of successive levels")
    log2_size: int = Field(19, ge=3, le=24, description="T: a level has at most 2^T entries")
    halvings: int = Field(0, ge=0, le=8, description="subtracted from T, down to 3: what the rate points set")

    @property
    def log2_table(self) -> int:
        """Logarithm of the most entries of a level."""
        return max(self.log2_size - self.halvings, 3)

    @property
    def sizes(self) -> dict[str, Any]:
        """Arguments of a `ColorField` that say how large its grid is."""
        names = ("levels", "features", "coarsest", "growth")
        return {**{name: getattr(self, name) for name in names}, "log2_size": self.log2_table}


class Network(Params):
    """The network behind the grid, and step sizes of both."""

    hidden: int = Field(64, ge=1, le=256, description="width of the two hidden layers")
    lr: float = Field(0.01, gt=0, description="Adam step size of grid and network")
    warm_up: int = Field(100, ge=0, description="steps over which it rises from a hundredth")
    lr_steps: list[Annotated[int, Field(ge=1)]] = Field(
        [5_000, 15_000, 25_000], description="steps after which it is multiplied by `network.lr_factor`"
    )
    lr_factor: float = Field(0.33, gt=0, le=1, description="its factor at each of these")


class RVQ(Params):
    """Residual vector quantisation of scales and rotations, once each."""

    start: int = Field(29_000, ge=1, description="first step that renders quantised shapes and trains their codebooks")
    size: int = Field(64, ge=1, le=4096, description="entries of a stage")
    stages: int = Field(6, ge=1, le=16, description="stages: entries whose sum is a scale or a rotation")
    lr: float = Field(1e-4, ge=0, description="Adam step size of the entries")


class FileSettings(Params):
    """Settings of the file."""

    pp: bool = Field(True, description="post-processing: 8-bit opacity and grid, coded indices, packed positions")
    coder: str = Field("huffman", description="entropy coder of the post-processing, by name")
    grid_threshold: float = Field(0.1, ge=0, description="post-processing makes values of the grid up to this zero")
    grid_step: float = Field(0, ge=0, description="its 8-bit steps are no shorter; 0: its range / 255, as published")
    grid_factor: float = Field(1.0, ge=0, description="multiplies these two: what the rate points set")


class Codec(OwnCodec):
    """The file of Compact3DGS, which no other codec can write."""

    name: Literal["compact3dgs"] = Field("compact3dgs", description="the file of Compact3DGS")
    settings: FileSettings = Field(FileSettings(), description="settings of the file")


class Compact3DGSConfig(Capped, Choosing):
    """Everything that can be set for Compact3DGS."""

    OLDER: ClassVar[Mapping[str, Moved]] = DENSIFY

    lr: LearningRates = Field(LearningRates(), description="step sizes of the Gaussians")
    density: DensityChoice = Field(DensityChoice(), description="density control")
    loss: Loss = Field(Loss(), description="photometric loss")
    pictures: Pictures = Field(Pictures(), description="sizes of the training pictures")
    mask: Mask = Field(Mask(), description="the volume mask")
    grid: Grid = Field(Grid(), description="hash grid")
    network: Network = Field(Network(), description="network behind the grid")
    rvq: RVQ = Field(RVQ(), description="codebooks of scales and rotations")
    codec: Codec = Field(Codec(), description="what writes the file")

    @property
    def base(self) -> GaussianTraining:
        """Hyper-parameters of the stage of 3DGS inside. What they add (SH) has no effect."""
        return GaussianTraining(
            iterations=self.iterations,
            scale_schedule=self.scale_schedule,
            lr=GaussianRates(**vars(self.lr)),
            density=self.density,
            pictures=self.pictures,
            loss=self.loss,
        )
