"""Hyper-parameters of training explicit Gaussians. Defaults are those of the Splatwizard paper."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field

from splatwizard_core.api import OptimizationParams, Params, SameResult, apply_overrides
from sw_gaussians.fast import rate_factors

FUSED_FROM = 200_000
"""Gaussians from which updates in the backward pass save time: of 185,000 a step takes as long, of a million 0.91."""


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


class Densify(Params):
    """Adaptive density control."""

    start: int = Field(500, ge=0, description="first step that densifies (authors' code: 600)")
    stop: int = Field(15_000, ge=0, description="no densification, statistics or opacity reset from this step on")
    interval: int = Field(100, ge=1, description="steps between densifications")
    grad_threshold: float = Field(
        2e-4, gt=0, description="mean screen-space gradient that densifies, NDC units (with absgrad about 8e-4)"
    )
    percent_dense: float = Field(
        0.01, gt=0, description="largest scale up to which a Gaussian is cloned, above it split; times the scene extent"
    )
    min_opacity: float = Field(0.005, ge=0, lt=1, description="Gaussians fainter than this are pruned")
    world_prune: float = Field(
        0.1, gt=0, description="larger Gaussians are pruned once the first reset is past; times the scene extent"
    )
    prune_screen_px: float | None = Field(
        None, gt=0, description="Gaussians with a larger radius on screen are pruned, px; unset: never, as published"
    )
    reset_interval: int = Field(3_000, ge=1, description="steps between opacity resets")
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="opacity after a reset, at most")
    white_reset: int = Field(500, ge=0, description="step of an extra reset on a white background; 0: none")
    absgrad: bool = Field(False, description="sum absolute pixel gradients (AbsGS); raise grad_threshold with it")
    revised_opacity: bool = Field(False, description="children of a split get 1 - sqrt(1 - opacity)")
    pause_after_reset: int = Field(0, ge=0, description="steps after an opacity reset without densification")


class MCMC(Params):
    """Density control as in 3DGS-MCMC, in place of `densify` (arXiv 2404.09591)."""

    enabled: bool = Field(False, description="relocate, grow and shake Gaussians; no cloning, splitting or resets")
    cap: int = Field(1_000_000, ge=1, description="most Gaussians that growth makes")
    start: int = Field(600, ge=0, description="first step that relocates and grows")
    stop: int = Field(25_000, ge=0, description="no relocation or growth from this step on")
    interval: int = Field(100, ge=1, description="steps between relocations")
    growth: float = Field(0.05, ge=0, description="share of Gaussians that are added each time")
    min_opacity: float = Field(0.005, gt=0, lt=1, description="Gaussians up to this opacity are dead: relocated")
    noise: float = Field(5e5, ge=0, description="strength of the noise on the means, times their step size")
    opacity_weight: float = Field(0.01, ge=0, description="weight of the mean opacity in the loss")
    scale_weight: float = Field(0.01, ge=0, description="weight of the mean scale in the loss, world units")
    init_opacity: float = Field(0.5, gt=0, lt=1, description="opacity at the start")
    init_scale: float = Field(0.1, gt=0, description="scales at the start, times the distance to the neighbours")

    def first_values(self) -> dict[str, float]:
        """Return the arguments `opacity` and `scale_factor` of `gaussians_from_points`; none where it is off."""
        return {"opacity": self.init_opacity, "scale_factor": self.init_scale} if self.enabled else {}


class Fast(Params):
    """Parts of fast training, each off by default; the preset `fast` of 3dgs turns on what pays."""

    densify: Literal["threshold", "budget"] = Field(
        "threshold",
        description="threshold: density control of 3DGS; budget: drawn by a score, as many as a budget allows",
    )
    score: Literal["opacity_variance", "gradient"] = Field(
        "opacity_variance",
        description="of the draw: variance of the opacity gradient (LiteGS), or screen-space gradient",
    )
    cap: int = Field(1_000_000, ge=1, description="Gaussians that the budget rises to, linearly until densify.stop")
    growth: float = Field(
        1.0,
        ge=0,
        description="new Gaussians for each one over densify.grad_threshold, at most; 0: the cap alone counts",
    )
    opacity: Literal["reset", "halve"] = Field(
        "reset", description="every densify.reset_interval: reset: to at most densify.reset_opacity; halve: by half"
    )
    sh_every: int = Field(
        1, ge=1, description="steps between updates of SH bands 1 to 3, on the sum of their gradients"
    )
    morton: bool = Field(False, description="put Gaussians in Morton order at each densification (with budget)")
    resolution: Literal["none", "dash"] = Field(
        "none", description="dash: begin with small pictures, whole ones from densify.stop on (DashGaussian)"
    )
    resolution_rounding: Literal["real", "floor"] = Field(
        "real", description="scales of pictures: real: any; floor: whole ones, as published"
    )
    resolution_start: float = Field(4.0, ge=1, description="times that the first pictures are smaller, at most")
    resolution_hold: bool = Field(
        False, description="with dash, lr.position_init until the last level of half size or less, as published"
    )
    rates: Annotated[Literal["given", "length"], SameResult()] = Field(
        "given", description="length: lr.position_final and lr.sh_rest, unless given, are raised by how short a run is"
    )
    veto_views: int = Field(
        0, ge=0, description="views whose badly drawn pixels say what may get company (FastGS: 10); 0: no veto"
    )
    veto_pixels: float = Field(5.0, ge=0, description="with the veto: in more of them a view than this, on average")
    late_prune: bool = Field(
        False,
        description="in three rounds after density control remove what is faint, or what 10 views blame (FastGS)",
    )
    late_views: int = Field(
        1, ge=1, description="views whose summed gradients make one update, from the end of density control on (FastGS)"
    )
    settle: float = Field(
        1.0,
        gt=0,
        le=1,
        description="all rates but that of the means fall to so much of themselves from the end of density control on",
    )
    average: float = Field(
        0.0,
        ge=0,
        lt=1,
        description="share of the run, at its end and after density control, whose mean the model becomes",
    )

    def late(self) -> list[str]:
        """Return the keys that are on and act after density control alone."""
        return [f"fast.{name}" for name in LATE if getattr(self, name) != type(self).model_fields[name].default]


LATE = ("late_prune", "late_views", "settle", "average")
"""Keys of `Fast` that act after density control."""


class Loss(Params):
    """The photometric loss."""

    lambda_dssim: float = Field(0.2, ge=0, le=1, description="weight of 1 - SSIM; the rest is the weight of L1")
    ssim_padding: Literal["same", "valid"] = Field(
        "same", description="zeros beside the image, as published, or SSIM only where its window fits"
    )


class GaussianTraining(OptimizationParams):
    """Hyper-parameters of the 3DGS stage; a method that trains Gaussians adds its own keys."""

    sh_interval: int = Field(1_000, ge=1, description="steps between increases of the active SH degree")
    sparse_adam: Literal["off", "none", "per_row"] = Field(
        "off", description="update only what the view shows: none: without bias correction, as published; per_row: with"
    )
    lr: LearningRates = Field(LearningRates(), description="step sizes")
    densify: Densify = Field(Densify(), description="adaptive density control")
    mcmc: MCMC = Field(MCMC(), description="density control of 3DGS-MCMC, off by default")
    fast: Fast = Field(Fast(), description="parts of fast training, off by default")
    loss: Loss = Field(Loss(), description="photometric loss")

    def completed(self, plugins: Any, sources: Mapping[str, str]) -> OptimizationParams:
        """Return this with the learning rates that follow from its length, where `fast.rates` asks for it."""
        asked = super().completed(plugins, sources)
        if self.fast.rates == "given":
            return asked
        lr, factors = self.lr, rate_factors(self.iterations / self.FULL_ITERATIONS)
        whole = {"lr.position_final": lr.position_final, "lr.sh_rest": lr.sh_rest}
        rates = {key: factors[key] * rate for key, rate in whole.items() if key not in sources}
        return apply_overrides(asked, rates, source="fast.rates")
