"""Hyper-parameters of Trimming the Fat: when it prunes, how much, and how the rest is trained on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar, Literal

from pydantic import Field, model_validator
from sw_gaussians.choices import Choosing, CodecChoice, Moved, PrunerChoice
from sw_gaussians.finetune.fine_tuning import FineTuningRates
from sw_gaussians.sized import FILLING, Sized


class Prune(PrunerChoice):
    """The removals, and the gradient statistics that they go by."""

    pruner: str = Field("trimming-the-fat", description="whose scores: any registered pruner")
    level: float = Field(
        0.425, ge=0, le=1, description="gamma: below this quantile of opacity and of gradient, a Gaussian goes"
    )
    fraction: float | None = Field(
        None, ge=0, lt=1, description="share that goes each time with another pruner; unset: level squared"
    )
    start: int = Field(100, ge=1, description="first removal (authors' code: before the first step)")
    stop: int = Field(5_000, ge=0, description="no removal from this step on")
    interval: int = Field(500, ge=1, description="steps between removals")
    window: int = Field(99, ge=1, description="steps over which gradients are averaged, from the first one on")
    refresh: Literal["once", "every_interval"] = Field(
        "once", description="every_interval: gradients are averaged anew over the window before each removal"
    )
    statistics: Literal["fresh", "checkpoint"] = Field(
        "fresh", description="checkpoint: what the 3DGS training has left of its own, as in the authors' code"
    )

    @property
    def fraction_or_default(self) -> float:
        """Share for other pruners: as much as ours takes where opacity and gradient are independent."""
        return self.level**2 if self.fraction is None else self.fraction

    @model_validator(mode="after")
    def _has_statistics(self) -> Prune:
        if self.statistics == "checkpoint" and self.refresh == "every_interval":
            raise ValueError("prune.statistics=checkpoint collects nothing, so prune.refresh must be 'once'")
        return self


class TrimmingTheFatConfig(Sized, Choosing):
    """Everything that can be set for Trimming the Fat."""

    FILLED_BY: ClassVar[str] = FILLING
    FULL_ITERATIONS: ClassVar[int] = 15_000
    OLDER: ClassVar[Mapping[str, Moved]] = {"codec": Moved(("codec.name",))}

    iterations: int = Field(15_000, ge=1, description="steps after the trained scene (authors' code: 10,000)")
    prune: Prune = Field(Prune(), description="what is removed when")
    lr: FineTuningRates = Field(FineTuningRates(), description="step sizes")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the loss; the rest is that of L1")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")
