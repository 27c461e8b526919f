"""Hyper-parameters of wisp. Steps are those of the full run of 18,000, after the scene that it starts from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field, PositiveFloat
from sw_gaussians.named_blocks import Choosing, Moved, OwnCodec

from splatwizard_core.api import Params
from sw_wisp.numbers import LATENTS


class Budget(Params):
    """Number of splats that the training begins with, 1.5 caps at most; removal decides how many stay."""

    cap: int | None = Field(None, ge=1, description="most splats, times `budget.cap_factor`; None: by training pixels")
    density: float = Field(
        1.0, gt=0, le=1, description="splats per training pixel at most, where `budget.cap` is None: more fit noise"
    )
    cap_factor: float = Field(0.8, gt=0, le=10, description="what the rate points set")
    worthless: float = Field(0.2, ge=0, lt=1, description="largest share dropped first, of as many as do harm")


class RateTerm(Params):
    """The bits in the loss: lambda times bits of the whole file over the pixels of all training pictures, over 100."""

    DEFAULTS: ClassVar[int] = 1

    lambda_: float = Field(1e-4, ge=0, description="weight: what the rate points set")
    start: int = Field(2_000, ge=0, description="step at which it begins to rise from 0")
    ramp: int = Field(2_000, ge=1, description="steps over which it rises")
    sample: float = Field(0.15, gt=0, le=1, description="share of all splats whose bits are counted at a step")


class Steps(Params):
    """Quantiser steps of the numbers of a splat, or where they start from if they follow the networks."""

    opacity: float = Field(0.2, gt=0, le=4, description="of the opacity logit")
    shape: float = Field(0.12, gt=0, le=4, description="of the five numbers of the log covariance's deviator")
    size: float = Field(0.07, gt=0, le=4, description="of the mean log scale")
    luma: float = Field(0.015, gt=0, le=4, description="of the luma of SH band 0")
    chroma: float = Field(0.02, gt=0, le=4, description="of its two chromas")
    latents: float = Field(0.12, gt=0, le=4, description="of the latents, SH units")
    factor: float = Field(1.0, gt=0, le=8, description="multiplies all of them")
    adaptive: bool = Field(True, description="let them follow the networks of the context, by splat")


class Context(Params):
    """Prediction of the numbers of a splat."""

    kind: Literal["none", "pyramid"] = Field(
        "pyramid", description="none: a Gaussian by number and level; pyramid: networks on means of the splats before"
    )
    networks: Literal["large", "small"] = Field("large", description="small: half as many hidden numbers")
    fit: int = Field(600, ge=0, le=100_000, description="updates of the networks on bits alone when noise begins")
    rebuild: int = Field(200, ge=1, description="steps between measurements; half as many while numbers are rounded")


class Positions(Params):
    """The cell of a splat: its level in the octree."""

    rule: Literal["mid", "sensitivity"] = Field(
        "sensitivity",
        description="mid: cells of eta times the middle scale; sensitivity: by the error that a shift makes",
    )
    eta: float = Field(0.5, gt=0, le=4, description="edge of a cell in middle scales: what the rate points set")
    level_min: int = Field(3, ge=3, le=18, description="coarsest level")
    level_max: int = Field(18, ge=3, le=18, description="finest level")


class Prune(Params):
    """Removal of splats that cost more bits than they are worth."""

    rd: bool = Field(True, description="remove where the change of the pictures costs less than lambda times the bits")
    start: int = Field(2_500, ge=1, description="step of the first removal")
    stop: int = Field(10_501, ge=1, description="no removal from this step on")
    every: int = Field(1_000, ge=1, description="steps between removals")
    share: float = Field(0.15, gt=0, lt=1, description="largest share of the splats that one of them takes")
    respawn: float = Field(1 / 3, ge=0, le=1, description="share of the removed that comes back as copies of others")
    respawn_stop: int = Field(8_000, ge=0, description="none come back from this step on")


class Phases(Params):
    """When a training goes from floats to integers."""

    noise: int = Field(1_501, ge=1, description="first step with uniform noise in place of rounding")
    levels: list[int] = Field([6_000, 9_000], description="steps that set levels anew; the first fixes them")
    cells: int = Field(6_001, ge=1, description="first step with noise of a cell's edge on the positions")
    place: int = Field(11_500, ge=1, description="step that puts every splat into its cell for good")
    soft: int = Field(13_000, ge=1, description="first step of soft rounding")
    sharpness: float = Field(8.0, gt=1, le=64, description="of soft rounding at its end; it begins at 1")
    hard: int = Field(15_501, ge=1, description="first step that rounds, with straight-through gradients")
    subsets: int = Field(11_500, ge=1, description="with layers: step that forms the subsets of splats")
    prefixes: int = Field(12_001, ge=1, description="with layers: first step that may draw some packets alone")
    order: int = Field(16_000, ge=1, description="with layers: step that fixes the order of packets")
    freeze: int = Field(17_000, ge=1, description="step that fixes all integers; floats of the file learn on")


class Rate(Params):
    """An Adam step size that falls log-linearly over the training."""

    first: float = Field(gt=0, description="at the first step")
    last: float = Field(gt=0, description="at the last step")


class LearningRates(Params):
    """Adam step sizes."""

    means: Rate = Field(Rate(first=1.6e-5, last=1.6e-6), description="of the positions, times the scene extent")
    opacity: Rate = Field(Rate(first=0.025, last=2.5e-3), description="of the opacity logits")
    shape: Rate = Field(Rate(first=4e-3, last=4e-4), description="of the log covariances")
    colour: Rate = Field(Rate(first=2.5e-3, last=2.5e-4), description="of luma and chroma")
    latents: Rate = Field(Rate(first=5e-3, last=5e-4), description="of the latents")
    networks: Rate = Field(Rate(first=2e-3, last=1e-4), description="of the networks")


class Appearance(Params):
    """View dependence: latents of a splat and the network that turns them into SH bands 1 and up."""

    hidden: int = Field(32, ge=1, le=256, description="hidden numbers of the network")
    steps: Literal["equal", "sensitivity"] = Field(
        "equal", description="quantiser steps of the latents: all alike, or each by how much the pictures depend on it"
    )
    spread: float = Field(2.0, ge=1, le=8, description="largest factor between such a step and the base step")


class Loss(Params):
    """The loss besides the bits."""

    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM; the rest is the weight of L1")
    opacity: float = Field(0.002, ge=0, description="weight of the mean opacity")
    opacity_stop: int = Field(10_501, ge=0, description="step from which on that term is gone")


class LayersOfTheFile(Params):
    """Layers: the file comes in packets, and each prefix of them is a scene."""

    progressive: bool = Field(False, description="write splats in subsets, and their numbers coarse before fine")
    shares: list[PositiveFloat] = Field(
        [0.12, 0.18, 0.28, 0.42], min_length=1, max_length=16, description="of the bits of first packets, by subset"
    )
    planes: int = Field(1, ge=0, le=2, description="refinements of shape, size and colour, each by a factor 3")
    train: float = Field(0.5, ge=0, le=1, description="share of steps that draw some packets alone")
    weight: float = Field(1.0, gt=0, le=1, description="of the loss of such a step")
    swell: int = Field(
        60, ge=0, le=10_000, description="updates that fit size and opacity of subsets for each number of missing ones"
    )
    every: int = Field(2_000, ge=0, description="steps between such fits in training; 0: one at the end alone")
    views: int = Field(16, ge=1, description="training views by which the order of packets is chosen")


class Codec(OwnCodec):
    """The file of wisp, which no other codec can write."""

    name: Literal["wisp"] = Field("wisp", description="the file of wisp")


class WispConfig(Choosing):
    """Everything that can be set for wisp."""

    FULL_ITERATIONS: ClassVar[int] = 18_000
    OLDER: ClassVar[Mapping[str, Moved]] = {"encode.rdoq": Moved((), False)}
    REFUSES: ClassVar = {"gaussians": "its splats are bounded by --set budget.cap=N"}

    iterations: int = Field(18_000, ge=1, le=10**9, description="steps after the scene that it starts from")
    budget: Budget = Field(Budget(), description="how many splats begin")
    rate_term: RateTerm = Field(RateTerm(), description="bits in the loss")
    steps: Steps = Field(Steps(), description="base quantiser steps")
    context: Context = Field(Context(), description="what predicts the numbers")
    positions: Positions = Field(Positions(), description="cells of splats")
    prune: Prune = Field(Prune(), description="removal of splats")
    phases: Phases = Field(Phases(), description="from floats to integers")
    lr: LearningRates = Field(LearningRates(), description="step sizes")
    appearance: Appearance = Field(Appearance(), description="view dependence")
    loss: Loss = Field(Loss(), description="the rest of the loss")
    layers: LayersOfTheFile = Field(LayersOfTheFile(), description="packets of the file")
    size: str = Field("", description="bytes of the file at most: 5MB; lambda is led to it; empty: as lambda has it")
    codec: Codec = Field(Codec(), description="what writes the file")

    @property
    def base_steps(self) -> tuple[float, ...]:
        """Quantiser steps of the 22 numbers."""
        s = self.steps
        steps = (s.opacity, *(s.shape,) * 5, s.size, s.luma, s.chroma, s.chroma, *(s.latents,) * LATENTS.width)
        return tuple(s.factor * step for step in steps)
