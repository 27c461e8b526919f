"""Hyper-parameters of TrimGS: the fine-tuning, its trims and densification; on ellipsoids also its normals."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field
from sw_gaussians.choices import Choosing, CodecChoice, PrunerChoice
from sw_gaussians.config import GaussianTraining
from sw_gaussians.finetune.fine_tuning import FineTuningRates
from sw_gaussians.sized import Capped, Sized

from splatwizard_core.api import Params
from sw_trimgs.scale_split import Box


class FlatConfig(Capped, GaussianTraining):
    """Everything that can be set for 3DGS with flat Gaussians."""

    sh_degree: int = Field(3, ge=0, le=3, description="highest degree of the spherical harmonics")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")


class Rates(FineTuningRates):
    """Step sizes of the fine-tuning: those of 3DGS, whose whole decay of the means is run again."""

    position_init: float = Field(1.6e-4, gt=0, description="of the means at step 0 of the decay, times the extent")
    max_steps: int = Field(7_000, ge=1, description="steps over which the rate of the means decays")


class Densify(Params):
    """Density control of the fine-tuning."""

    mode: Literal["ordinary", "scale", "mix"] = Field(
        "scale", description="clone and split by gradient as in 3DGS, split by scale, or one after the other"
    )
    interval: int = Field(100, ge=1, description="steps between densifications")
    stop: int = Field(7_000, ge=0, description="no densification, trim or opacity reset from this step on")
    grad_threshold: float = Field(
        2e-4, gt=0, description="mean screen-space gradient that densifies in modes ordinary and mix, NDC units"
    )
    percent_dense: float = Field(0.01, gt=0, description="scale that separates clone and split, times the extent")
    world_prune: float = Field(
        0.1, gt=0, description="larger Gaussians are pruned in modes ordinary and mix; times the scene extent"
    )
    min_opacity: float = Field(0.005, ge=0, lt=1, description="Gaussians fainter than this are pruned")
    factor: float = Field(1.0, gt=0, description="k: the scale split takes scales above percent_dense times k")
    size_px: float = Field(
        100, gt=0, description="it also takes larger radii on screen, px; without effect in mode mix, as published"
    )
    box: Box = Field("own", description="room around the cameras where it splits; xx: as deep as wide, authors' code")
    reset_interval: int = Field(3_000, ge=0, description="steps between opacity resets; 0: never")
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="opacity after a reset, at most")


class Trimming(PrunerChoice):
    """The removals of what contributes least."""

    pruner: str = Field("trimgs", description="whose scores decide: any registered pruner with scores of 0 or more")
    ratio: float = Field(0.1, ge=0, lt=1, description="p: what scores below this quantile goes, each time")
    after: int = Field(1_000, ge=0, description="no trim up to this step")
    interval: int = Field(500, ge=1, description="steps between trims, each of which follows a densification")
    unseen: bool = Field(True, description="from the second trim on all goes that no view shows; False: as published")


class Normals(Params):
    """Regularisation by normals."""

    weight: float = Field(0.5, ge=0, description="of both terms in the loss; 0: none")
    after: int = Field(0, ge=0, description="no regularisation up to this step")
    reach: int = Field(2, ge=1, description="d: pixels between the depths that a normal is made of, each way")
    edge_threshold: float = Field(
        0.05, ge=0, description="pixels where the depth changes by more do not count, world units a pixel; 0: all do"
    )
    erosion: int = Field(1, ge=0, description="pixels around those that do not count either")
    close: float = Field(1.0, gt=0, description="Gaussians that are smoothed are this near to the depth, world units")
    neighbors: int = Field(16, ge=2, description="how many the mean normal is of, the Gaussian itself included")
    refresh: int = Field(500, ge=1, description="steps between two searches for them, beside that after each change")


class TuneConfig(Sized, Choosing):
    """Settings of the fine-tuning, whatever it trains."""

    FULL_ITERATIONS: ClassVar[int] = 7_000

    iterations: int = Field(7_000, ge=1, description="steps after the trained scene")
    lr: Rates = Field(Rates(), description="step sizes")
    densify: Densify = Field(Densify(), description="density control")
    trim: Trimming = Field(Trimming(), description="removal of what contributes least")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the loss; the rest is that of L1")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")


class Trim3DGSConfig(TuneConfig):
    """Everything that can be set for TrimGS on flat Gaussians."""

    start: Literal["flat-3dgs", "3dgs"] = Field(
        "flat-3dgs", description="whose trained scene; that of 3dgs, like any .ply, is flattened first"
    )
    normals: Normals = Field(Normals(), description="regularisation by normals")
