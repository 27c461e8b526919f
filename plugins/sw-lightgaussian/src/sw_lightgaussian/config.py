"""Hyper-parameters of LightGaussian. Defaults: the authors' scripts, which is what the paper's figures belong to."""

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field
from sw_gaussians.choices import Choosing, CodecChoice, Moved, PrunerChoice
from sw_gaussians.finetune.distillation import DistillLoss
from sw_gaussians.finetune.fine_tuning import FineTuningRates
from sw_gaussians.finetune.pruning import CountRule
from sw_gaussians.sized import Sized

from splatwizard_core.api import Params
from sw_lightgaussian.importance_vq import VQSettings
from sw_lightgaussian.significance import SignificanceSettings


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


class Score(PrunerChoice):
    """The pruner whose scores say what keeps its own colours in the file."""

    pruner: str = Field("lightgaussian", description="whose scores say what matters for the file: any pruner")


class Prune(PrunerChoice):
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


_CODEC_KEYS = {
    "vq_ratio": "ratio", "codebook_size": "size", "rows_per_code": "rows_per_code", "vq_iterations": "iterations",
    "vq_batch": "batch", "vq_decay": "decay", "vq_reseed": "reseed", "vq_training": "training",
}  # fmt: skip
_SCORE, _CODEC = SignificanceSettings.model_fields, VQSettings.model_fields


class LightGaussianConfig(Sized, Choosing):
    """Everything that can be set for LightGaussian."""

    FULL_ITERATIONS: ClassVar[int] = 5_000
    OLDER: ClassVar[Mapping[str, Moved]] = {
        # One score decided what is pruned and what matters for the file.
        **{
            f"score.{k}": Moved((f"prune.settings.{k}", f"score.settings.{k}"), _SCORE[k].default, "lightgaussian")
            for k in _SCORE
        },
        **{
            f"codec.{old}": Moved((f"codec.settings.{k}",), _CODEC[k].default, "vectree")
            for old, k in _CODEC_KEYS.items()
        },
    }

    iterations: int = Field(5_000, ge=1, description="steps of the distillation")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the losses; the rest is that of L1")
    score: Score = Field(Score(), description="what keeps its own colours in the file")
    prune: Prune = Field(Prune(), description="stage 1")
    distill: Distill = Field(Distill(), description="stage 2")
    codec: CodecChoice = Field(CodecChoice(name="vectree"), description="what writes the file")
