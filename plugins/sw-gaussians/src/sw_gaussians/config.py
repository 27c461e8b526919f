"""Hyper-parameters of training explicit Gaussians. Defaults are those of the Splatwizard paper."""

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field

from splatwizard_core.api import Params, SameResult, apply_overrides
from sw_gaussians.density.choice import DensityChoice
from sw_gaussians.named_blocks import Exchangeable, Moved
from sw_gaussians.older_keys import OLDER, translated
from sw_gaussians.pictures import Pictures


class LearningRates(Params):
    """Adam step sizes of the six parameter groups."""

    position_init: float = Field(1.6e-4, gt=0, description="of the means at step 0, times the scene extent")
    position_final: float = Field(1.6e-6, gt=0, description="of the means at step `max_steps`, times the scene extent")
    position_delay_steps: int = Field(0, ge=0, description="steps of damped start; 0: none")
    position_delay_mult: float = Field(0.01, ge=0, le=1, description="damping at step 0; without delay steps no effect")
    max_steps: int = Field(30_000, ge=1, description="steps over which the position rate decays")
    sh_dc: float = Field(2.5e-3, ge=0, description="of SH band 0")
    sh_rest: float = Field(1.25e-4, ge=0, description="of SH bands 1 to 3 (band 0 / 20)")
    opacity: float = Field(0.05, ge=0, description="of the opacity logits (authors' code of 2024: 0.025)")
    scales: float = Field(5e-3, ge=0, description="of the log scales")
    quats: float = Field(1e-3, ge=0, description="of the quaternions")
    beta2: float = Field(
        0.999, gt=0, lt=1, description="share of its squared gradients that Adam keeps per step; short runs want less"
    )


class Fast(Params):
    """Optional speed-ups of training, all off by default; preset `fast` of 3dgs enables those that pay."""

    rates: Annotated[Literal["given", "length"], SameResult()] = Field(
        "given", description="length: lr.position_final and lr.sh_rest, unless given, are raised by how short a run is"
    )
    late_views: int = Field(
        1, ge=1, description="views whose summed gradients make one update, from the end of density control on (FastGS)"
    )
    average: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="share of the run, at its end and after density control, whose mean the model becomes",
    )


class Loss(Params):
    """The photometric loss."""

    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM; the rest is the weight of L1")
    ssim_padding: Literal["same", "valid"] = Field(
        "same", description="zeros beside the image, as published, or SSIM only where its window fits"
    )


class GaussianTraining(Exchangeable):
    """Hyper-parameters of the 3DGS stage; a method that trains Gaussians adds its own keys."""

    OLDER: ClassVar[Mapping[str, Moved]] = OLDER

    sh_interval: int = Field(1_000, ge=1, description="steps between increases of the active SH degree")
    sparse_adam: bool = Field(False, description="Adam of what the view shows alone, without bias correction (Taming)")
    lr: LearningRates = Field(LearningRates(), description="step sizes")
    density: DensityChoice = Field(DensityChoice(), description="density control")
    pictures: Pictures = Field(Pictures(), description="sizes of the training pictures")
    fast: Fast = Field(Fast(), description="parts of fast training, off by default")
    loss: Loss = Field(Loss(), description="photometric loss")

    def translated(self, values: dict[str, Any]) -> dict[str, Any]:
        return translated(super().translated(values), self.density)

    def completed(self, plugins: Any, sources: Mapping[str, str]) -> Any:
        """Return this with learning rates scaled to the length of the run, if `fast.rates` is set."""
        asked = super().completed(plugins, sources)
        if self.fast.rates == "given":
            return asked
        lr, factors = self.lr, rate_factors(self.iterations / self.FULL_ITERATIONS)
        whole = {"lr.position_final": lr.position_final, "lr.sh_rest": lr.sh_rest}
        rates = {key: factors[key] * rate for key, rate in whole.items() if key not in sources}
        return apply_overrides(asked, rates, source="fast.rates")


SHORT, LONG = 0.4, 0.8
"""Bounds, as shares of the full schedule: shorter runs count as short, longer ones as long."""


def rate_factors(share: float) -> dict[str, float]:
    """Return the factors of two learning rates in a run of a given share, > 0, of the full schedule.

    A short run ends with a larger learning rate of the means, as they have less time to converge. The factor is
    log-interpolated up to a long run. SH bands 1 to 3 have twice the rate in every run that is not long.

    Source: LiteGS (arXiv 2503.01199), whose values are those of a third of the plan and of the whole; between: our own.
    """
    q = min(max((share - SHORT) / (LONG - SHORT), 0.0), 1.0)
    return {"lr.position_final": 10.0 ** (1 - q), "lr.sh_rest": 2.0 if share < LONG else 1.0}
