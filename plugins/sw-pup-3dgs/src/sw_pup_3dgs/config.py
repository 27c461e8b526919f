"""Hyper-parameters of PUP 3D-GS: the rounds, what each removes, and how the rest is trained on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field, model_validator
from sw_gaussians.choices import Choosing, CodecChoice, Moved, PrunerChoice
from sw_gaussians.finetune.fine_tuning import FineTuningRates
from sw_gaussians.finetune.pruning import CountRule
from sw_gaussians.sized import FILLING, Sized


class Prune(PrunerChoice):
    """The rounds: each begins with a removal."""

    pruner: str = Field("pup-3dgs", description="whose scores: any registered pruner")
    steps: list[int] = Field([1, 5_001], description="first step of each round: it removes, and updates nothing")
    fractions: list[float] = Field([0.8, 0.5], description="share that goes in each round, of what is left")
    count_rule: CountRule = Field(
        "exact", description="official: all up to the score at index int(share (N - 1)), as in the authors' code"
    )
    window: int = Field(
        99, ge=1, description="for a pruner that reads gradient statistics: steps that collect them before a removal"
    )

    @model_validator(mode="after")
    def _one_share_a_round(self) -> Prune:
        if not self.steps or len(self.steps) != len(self.fractions):
            raise ValueError(f"prune.steps names {len(self.steps)} rounds, prune.fractions {len(self.fractions)}")
        if self.steps != sorted(set(self.steps)) or self.steps[0] < 1:
            raise ValueError(f"prune.steps must ascend from 1 or more, not {self.steps}")
        if not all(0 <= share < 1 for share in self.fractions):
            raise ValueError(f"prune.fractions must be shares, 0 up to but not including 1, not {self.fractions}")
        return self


class Rates(FineTuningRates):
    """As in the authors' code, which counts on from 30,000: the end of an exponential decay over 35,000 steps."""

    position_init: float = Field(1.6e-4, gt=0, description="of the means at step 0 of the decay, times the extent")
    position_offset: int = Field(30_000, ge=0, description="steps of the decay that lie before each round")
    max_steps: int = Field(35_000, ge=1, description="steps over which the rate of the means decays")
    decay: float = Field(0.95, gt=0, le=1, description="factor on all rates but that of the means, again and again")


class Pup3DGSConfig(Sized, Choosing):
    """Everything that can be set for PUP 3D-GS."""

    FILLED_BY: ClassVar[str] = FILLING
    FULL_ITERATIONS: ClassVar[int] = 10_000
    OLDER: ClassVar[Mapping[str, Moved]] = {
        "codec": Moved(("codec.name",)),
        "prune.resolution": Moved(("prune.settings.resolution",), 4, "pup-3dgs"),
    }

    iterations: int = Field(10_000, ge=1, description="steps after the trained scene, all rounds together")
    prune: Prune = Field(Prune(), description="what is removed when")
    lr: Rates = Field(Rates(), description="step sizes; each round begins with them anew")
    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM in the loss; the rest is that of L1")
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")
