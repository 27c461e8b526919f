"""Hyper-parameters of ChimeraGS: which parts it is made of, and its own stage in between.

Defaults: the code of the Splatwizard paper's authors and the two methods whose parts these are; the paper has none.
"""

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

from pydantic import Field
from sw_gaussians.choices import Choice, Choosing, Moved, PrunerChoice
from sw_gaussians.finetune.distillation import DistillLoss
from sw_gaussians.finetune.fine_tuning import FineTuningRates
from sw_gaussians.older_keys import within
from sw_gaussians.sized import CappedBase

from splatwizard_core.api import Params


class Train(Params):
    """Stage 1: whose training makes the student."""

    method: str = Field("speedy-splat", description="any installed method of explicit Gaussians; its stages run first")
    soft: float = Field(0.80, ge=0, lt=1, description="`prune.soft` of speedy-splat; other methods do not read it")
    hard: float = Field(0.30, ge=0, lt=1, description="`prune.hard` of speedy-splat; other methods do not read it")
    stop: int = Field(30_000, ge=0, description="`prune.stop` of speedy-splat; other methods do not read it")


class Mask(Params):
    """The mask on the coefficients of SH degree 3, one logit a Gaussian."""

    init: float = Field(-4.5951, description="logit at the start: just on, sigmoid(-4.5951) = 0.0100002")
    threshold: float = Field(0.01, gt=0, lt=1, description="a mask is on where its sigmoid is above this")
    lr: float = Field(1e-3, ge=0, description="Adam step size of the logits")
    weight: float = Field(1e-2, ge=0, description="weight of the mean sigmoid in the loss (with loss l2 about 2e-4)")


class Distill(Params):
    """Stage 2: the student learns from a frozen teacher, and which Gaussians need degree 3."""

    iterations: int = Field(5_000, ge=1, description="steps of the stage, of the full run")
    teacher: str = Field(
        "3dgs", description="the method whose trained scene teaches; student_initial: what stage 1 left"
    )
    loss: DistillLoss = Field("l1_ssim", description="between the two renders; l2: as the paper has it")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in l1_ssim; the rest is that of L1")
    pseudo_views: bool = Field(True, description="move the camera in two steps of three")
    pseudo_view_std: float = Field(0.05, ge=0, description="standard deviation of its centre along each axis")
    pseudo_view_extent: float = Field(
        0, ge=0, description="scene extent for which that is meant, it scales along; 0: it is in world units"
    )
    lr: FineTuningRates = Field(FineTuningRates(), description="step sizes")
    beta2: float = Field(0.999, gt=0, lt=1, description="share of its squared gradients that Adam keeps per step")


class Score(PrunerChoice):
    """The pruner whose scores say how much each Gaussian matters for the file."""

    pruner: str = Field("lightgaussian", description="whose scores: any registered pruner")


class Codec(Choice):
    """The coder of the vectors of colour, each group with a codebook of its own."""

    REGISTRY: ClassVar[str] = "vector_coders"
    PARTS: ClassVar[tuple[str, ...]] = ("sh2", "sh3")

    name: str = Field("importance-vq", description="coder of vectors: any registered one")
    settings: dict[str, object] = Field({}, description="settings of the chosen one, by its own keys")
    sh2: dict[str, object] = Field({"ratio": 0.8}, description="settings for the degree-2 group alone, which win")
    sh3: dict[str, object] = Field({"ratio": 0.6}, description="the same for the degree-3 group")


class Steps(Params):
    """Roundings before float16, so that its bytes repeat; 0: to float16 alone, as published. The decoder needs none."""

    colors: float = Field(0, ge=0, le=1, description="SH coefficients become multiples of this, best a power of two")
    opacity: float = Field(0, ge=0, le=4, description="the same of the opacity logits")
    scales: float = Field(0, ge=0, le=1, description="the same of the log scales")
    quats: float = Field(0, ge=0, le=0.25, description="the same of the quaternions, which get length 1 and w >= 0")


_SHARED = {"training": "ema", "size": 8192, "iterations": 1_000, "batch": 80_000}


class ChimeraConfig(CappedBase, Choosing):
    """Everything that can be set for ChimeraGS."""

    BASE: ClassVar[str] = "student"
    ENCODING: ClassVar[tuple[str, ...]] = ("codec", "steps", "xyz", "arrays", "prefer", "vq", "size")
    OLDER: ClassVar[Mapping[str, Moved]] = {
        "vq.codec": Moved(("codec.name",), "importance-vq"),
        "vq.ratio2": Moved(("codec.sh2.ratio",), 0.8, "importance-vq"),
        "vq.ratio3": Moved(("codec.sh3.ratio",), 0.6, "importance-vq"),
        **{f"vq.{k}": Moved((f"codec.settings.{k}",), v, "importance-vq") for k, v in _SHARED.items()},
        "score.v_pow": Moved(("score.settings.v_pow",), 0.1, "lightgaussian"),
    }

    train: Train = Field(Train(), description="stage 1")
    student: dict[str, Any] = Field(
        {}, description="values of `train.method` by its keys (student.prune.interval=500), and its preset"
    )
    distill: Distill = Field(Distill(), description="stage 2")
    mask: Mask = Field(Mask(), description="which Gaussians keep SH degree 3")
    score: Score = Field(Score(), description="whose colours are kept")
    codec: Codec = Field(Codec(), description="the colours in the file")
    steps: Steps = Field(Steps(), description="roundings of what the file holds in float16")
    xyz: Literal["float32", "float16", "uniform16"] = Field(
        "float32", description="positions in the file: without loss, rounded, or on 2^16 steps of the bounding box"
    )
    arrays: str = Field(
        "byte-planes", description="coder of what the file holds in float16 besides colours: any that codes such arrays"
    )
    prefer: list[str] = Field(
        ["flash", "tcgs", "speedy", "standard"],
        description="what should draw the file, best first; any other rasterizer if none of them can",
    )

    def translated(self, values: dict[str, Any]) -> dict[str, Any]:
        if values.pop("vq.preset", "own") == "toolkit":
            values["vq.training"] = "official"
        return within(values, "student.base.")
