"""Hyper-parameters of LightGaussian. Defaults: the authors' scripts, which is what the paper's figures belong to."""

from typing import ClassVar, Literal

from pydantic import Field
from sw_finetuning.distillation import DistillLoss
from sw_finetuning.fine_tuning import FineTuningRates
from sw_finetuning.pruning import CountRule

from splatwizard_core.api import OptimizationParams, Params
from sw_lightgaussian.importance_vq import Training
from sw_lightgaussian.significance import Kind, VolumeNorm


class PruneRates(FineTuningRates):
    """Step sizes while pruning: the schedule of 3DGS goes on from step 30,000 to 35,000."""

    position_init: float = Field(1.6e-4, gt=0, description="of the means at step 0 of the decay, times the extent")
    position_offset: int = Field(30_000, ge=0, description="steps of the decay that lie before this stage")
    max_steps: int = Field(35_000, ge=1, description="steps over which the rate of the means decays")
    decay: float = Field(0.95, gt=0, le=1, description="factor on all rates but that of the means, again and again")
    decay_interval: int = Field(400, ge=1, description="steps between two of these factors")


class DistillRates(FineTuningRates):
    """Step sizes while distilling: the schedule goes on from step 35,000 to 40,000; opacities are frozen."""

    position_init: float = Field(1.6e-4, gt=0, description="of the means at step 0 of the decay, times the extent")
    position_offset: int = Field(35_000, ge=0, description="steps of the decay that lie before this stage")
    max_steps: int = Field(40_000, ge=1, description="steps over which the rate of the means decays")
    opacity: float = Field(0.0, ge=0, description="of the opacity logits; 0: frozen")
    decay: float = Field(0.9, gt=0, le=1, description="factor on all rates but that of the means, again and again")
    decay_interval: int = Field(500, ge=1, description="steps between two of these factors")


class Score(Params):
    """Global significance: what is pruned (by the own pruner), and what keeps its own colours in the file."""

    kind: Kind = Field("v_important_score", description="which score, see the README")
    v_pow: float = Field(0.1, ge=0, description="power of the volume")
    volume_norm: VolumeNorm = Field(
        "unclamped", description="as in the authors' code, or paper_clamp: relative to the 90th percentile, at most 1"
    )
    use_transmittance: bool = Field(True, description="False: the score of early versions of the paper")


class Prune(Params):
    """Stage 1: remove the least significant, then recover."""

    iterations: int = Field(
        5_000, ge=1, description="steps of the stage, of the full run; never more than `iterations`"
    )
    pruner: str = Field("lightgaussian", description="whose scores decide: any registered pruner")
    percent: float = Field(0.66, ge=0, lt=1, description="share of the Gaussians that goes, 0..1")
    steps: list[int] = Field([1], description="steps that prune, of the full run")
    decay: float = Field(1.0, gt=0, le=1, description="the i-th of these steps removes percent x decay^i")
    count_rule: CountRule = Field(
        "exact", description="official: all up to the score at index int(share (N - 1)), as in the authors' code"
    )
    optimizer: Literal["restored", "fresh"] = Field(
        "restored", description="Adam goes on as the 3DGS training left it, as in the authors' code, or starts afresh"
    )
    lr: PruneRates = Field(PruneRates(), description="step sizes")


class Distill(Params):
    """Stage 2: learn from the unpruned scene with fewer SH bands."""

    sh_degree: int = Field(2, ge=0, le=3, description="highest SH degree that is left")
    loss: DistillLoss = Field(
        "l1_ssim", description="between the two renders: as in the authors' code, or the paper's l2"
    )
    pseudo_views: bool = Field(True, description="move the camera in two steps of three")
    pseudo_view_std: float = Field(
        0.05, ge=0, description="standard deviation of its centre along each axis, world units"
    )
    lr: DistillRates = Field(DistillRates(), description="step sizes")


class Codec(Params):
    """The codec of the file."""

    name: str = Field("vectree", description="which codec for Gaussians; the keys below are those of vectree")
    vq_ratio: float = Field(0.6, ge=0, le=1, description="share of the Gaussians whose colours are vector-quantised")
    codebook_size: int = Field(8192, ge=2, le=1 << 16, description="codebook entries at most")
    rows_per_code: float = Field(4, ge=1, description="and no more than one for so many such Gaussians, a power of two")
    vq_iterations: int = Field(1000, ge=0, description="updates of the codebook")
    vq_batch: int = Field(80_000, ge=1, description="Gaussians of each update")
    vq_decay: float = Field(0.8, ge=0, lt=1, description="how much of the codebook's averages each update keeps")
    vq_reseed: int = Field(10, ge=0, description="entries that may start afresh after an update")
    vq_training: Training = Field("ema", description="official: the rule of the authors' code; kmeans: passes over all")


class LightGaussianConfig(OptimizationParams):
    """Everything that can be set for LightGaussian."""

    FULL_ITERATIONS: ClassVar[int] = 5_000

    iterations: int = Field(5_000, ge=1, description="steps of the distillation")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the losses; the rest is that of L1")
    score: Score = Field(Score(), description="global significance")
    prune: Prune = Field(Prune(), description="stage 1")
    distill: Distill = Field(Distill(), description="stage 2")
    codec: Codec = Field(Codec(), description="what the file holds")
