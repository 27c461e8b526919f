"""Hyper-parameters: default, bounds, unit."""

from pydantic import Field
from sw_finetuning.fine_tuning import FineTuningRates
from sw_gaussians.choices import Choosing, CodecChoice


class OpacityPruneConfig(Choosing):
    """Hyper-parameters of training on from a trained scene; that scene's own keys are `pretrained.KEY`."""

    iterations: int = Field(5_000, ge=1, description="steps after the trained scene")
    keep: float = Field(0.5, gt=0, le=1, description="fraction of the Gaussians that stay: the most opaque ones")
    lr: FineTuningRates = Field(FineTuningRates(), description="step sizes")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-quantized"), description="what writes the file")
