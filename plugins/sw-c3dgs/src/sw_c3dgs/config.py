"""Hyper-parameters of C3DGS. Defaults: the paper's and the authors' code, which agree in numbers."""

from typing import ClassVar

from pydantic import Field
from sw_gaussians.choices import Choosing, CodecChoice
from sw_gaussians.finetune.fine_tuning import FineTuningRates
from sw_gaussians.sized import Sized

from splatwizard_core.api import Params
from sw_codecs.codebooks.sharing import Training


class Codebook(Params):
    """One codebook, and who keeps an entry of its own."""

    size: int = Field(4096, ge=1, le=1 << 20, description="entries that are shared at most; kept ones come besides")
    threshold: float = Field(ge=0, description="more sensitive Gaussians keep their own entry")
    training: Training = Field(
        "batch-mean", description="the published loop; ema: ours over batches; kmeans: passes over all"
    )
    iterations: int = Field(ge=0, description="batches, or passes")
    batch: int = Field(ge=1, description="Gaussians of each batch, at most all; drawn with replacement")
    decay: float = Field(0.8, ge=0, lt=1, description="how much of the codebook each batch leaves")


class Colors(Codebook):
    """Codebook of colours: all SH coefficients of a Gaussian, band 0 included."""

    threshold: float = Field(0.6e-6, ge=0, description="more sensitive colours keep their own entry (paper: beta_c)")
    iterations: int = Field(100, ge=0, description="batches, or passes")
    batch: int = Field(1 << 18, ge=1, description="Gaussians of each batch, at most all; drawn with replacement")


class Shapes(Codebook):
    """Codebook of shapes: covariances of trace 1."""

    threshold: float = Field(0.3e-5, ge=0, description="more sensitive shapes keep their own entry (paper: beta_g)")
    iterations: int = Field(800, ge=0, description="batches, or passes")
    batch: int = Field(1 << 20, ge=1, description="Gaussians of each batch, at most all; drawn with replacement")


class Factors(Params):
    """Factors that the rate points set."""

    thresholds: float = Field(1.0, ge=0, description="times both thresholds: more of it, fewer own entries")
    sizes: float = Field(1.0, gt=0, le=16, description="times both sizes")


class Rates(FineTuningRates):
    """Step sizes: where the schedule of 3DGS ends. Those of `scales` are of the shapes and of the log factors."""

    max_steps: int = Field(5_000, ge=1, description="steps over which the rate of the means decays")

    def of_step(self, step: float, extent: float) -> dict[str, float]:
        found = super().of_step(step, extent)
        found["shapes"] = found["log_factors"] = found.pop("log_scales")
        return found


class C3DGSConfig(Sized, Choosing):
    """Everything that can be set for C3DGS."""

    FULL_ITERATIONS: ClassVar[int] = 5_000

    iterations: int = Field(5_000, ge=0, description="steps of fine-tuning; 0: only make codebooks and encode")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the loss; the rest is that of L1")
    prune_threshold: float = Field(
        0.0, description="Gaussians whose colour is not more sensitive go: 0: those that no view shows; below 0: none"
    )
    color: Colors = Field(Colors(), description="codebook of colours")
    shape: Shapes = Field(Shapes(), description="codebook of shapes")
    factors: Factors = Field(Factors(), description="factors on both codebooks")
    lr: Rates = Field(Rates(), description="step sizes")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-indexed"), description="what writes the file")
