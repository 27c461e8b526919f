"""Density control of 3DGS-MCMC: relocate dead Gaussians onto live ones, add new ones, add noise to positions.

Random numbers come from a stream per step, so there is no generator state to save: a resumed run draws the same
numbers. Source: 3D Gaussian Splatting as Markov Chain Monte Carlo (arXiv 2404.09591).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import torch
from pydantic import Field
from torch import Tensor

from splatwizard_core.api import ConfigError, DensityControl, GaussianModel, LossPack, Params, SplatOptimizer, stream
from sw_gaussians.density.splitting import rotate

if TYPE_CHECKING:
    from splatwizard_core.api import RenderResult, StageContext, TrainingState, View
    from splatwizard_core.training.density import DensityReport, DensityTask

MAX_COPIES = 51  # most copies per Gaussian in the relocation formula (size of the binomial table in the paper's code)
STEEPNESS = 100.0  # of the logistic that turns the noise off as a Gaussian becomes opaque


class MCMCSettings(Params):
    """Settings of density control by MCMC. Defaults are those of the paper's code."""

    cap: int | None = Field(1_000_000, ge=1, description="most Gaussians that growth makes; None: by training pixels")
    start: int = Field(600, ge=0, description="first step that relocates and grows")
    stop: int = Field(25_000, ge=0, description="no relocation or growth from this step on")
    interval: int = Field(100, ge=1, description="steps between relocations")
    growth: float = Field(0.05, ge=0, description="share of Gaussians that are added each time")
    min_opacity: float = Field(0.005, gt=0, lt=1, description="Gaussians up to this opacity are dead: relocated")
    noise: float = Field(5e5, ge=0, description="strength of the noise on the means, times their step size")
    noise_stop: int | None = Field(None, ge=0, description="no noise from this step on; None: until the end")
    opacity_weight: float = Field(0.01, ge=0, description="weight of the mean opacity in the loss")
    scale_weight: float = Field(0.01, ge=0, description="weight of the mean scale in the loss, world units")
    terms_stop: int | None = Field(
        None, ge=0, description="neither of the two in the loss from this step on; None: until the end"
    )
    init_opacity: float = Field(0.5, gt=0, lt=1, description="opacity at the start")
    init_scale: float = Field(0.1, gt=0, description="scales at the start, times the distance to the neighbours")


class MCMC(DensityControl):
    """3DGS-MCMC: relocation and growth every 100 steps, noise per step, opacity and scale regularisers."""

    Settings = MCMCSettings
    regularises = True

    @property
    def rounds(self) -> range:
        return range(self.settings.start, self.settings.stop, self.settings.interval)

    @property
    def until(self) -> int:
        return int(self.settings.stop)

    def start_values(self) -> dict[str, float]:
        return {"opacity": self.settings.init_opacity, "scale_factor": self.settings.init_scale}

    def begin(self, state: StageContext) -> None:
        if not isinstance(state.model, GaussianModel) or state.model.NUM_SCALES != GaussianModel.NUM_SCALES:
            raise ConfigError(
                "density=mcmc relocates Gaussians with three scales, which surfels do not have: set another one",
                key="density.name",
            )

    def pre_tasks(self) -> Iterable[DensityTask]:
        # It belongs to the update of the step before, and to that step's learning rate.
        stop = self.settings.noise_stop
        when = None if stop is None else range(stop)
        return [("add noise", when, self.shake)] if self.settings.noise > 0 else []

    def post_tasks(self) -> Iterable[DensityTask]:
        return ("relocate", self.rounds, self.adjust), ("grow", self.rounds, self.add)

    def shake(self, state: TrainingState) -> None:
        """Add noise to the means."""
        model = gaussians_of(state)
        if state.step > 1:  # before step 1 there was no update
            draws = stream(model.split_seed, f"noise/{state.step}", model.means.device)
            lr, settings = state.optimizer.lr("means"), self.settings
            add_noise(model, draws, lr=lr, strength=settings.noise, min_opacity=settings.min_opacity)

    def adjust(self, state: TrainingState) -> DensityReport:
        model = gaussians_of(state)
        draws = stream(model.split_seed, f"relocate/{state.step}")
        return {"relocated": relocate(model, state.optimizer, draws, min_opacity=self.settings.min_opacity)}

    def add(self, state: TrainingState) -> DensityReport:
        """Add Gaussians, up to the cap."""
        model, settings = gaussians_of(state), self.settings
        draws, least = stream(model.split_seed, f"grow/{state.step}"), settings.min_opacity
        cap = settings.cap or cap_for(state.scene.train)
        added = grow(model, state.optimizer, draws, cap=cap, growth=settings.growth, min_opacity=least)
        return {"added": added}

    def regularised(self, loss: LossPack, result: RenderResult, step: int) -> LossPack:
        """Add the opacity and scale regularisers, which turn unneeded Gaussians into dead ones, until they stop."""
        settings, inputs = self.settings, result.inputs
        if settings.terms_stop is not None:
            stop = self.when(settings.terms_stop)
            assert isinstance(stop, int)
            if step >= stop:
                return loss
        if inputs.scales is None:
            raise TypeError("density=mcmc needs a model with scales: that of 3dgs has them")
        parts = {"opacity": inputs.opacities.mean(), "scale": inputs.scales.mean()}
        total = loss.total + settings.opacity_weight * parts["opacity"] + settings.scale_weight * parts["scale"]
        return LossPack(total, loss.parts | {name: part.detach() for name, part in parts.items()})


def cap_for(views: Sequence[View]) -> int:
    """Return how many Gaussians are enough for training views: 250,000 for a hundred of 800x800."""
    return round(31.25 * math.sqrt(pixels_of(views)))


def pixels_of(views: Sequence[View]) -> int:
    """Return how many pixels the pictures of views have together."""
    return sum(view.camera.width * view.camera.height for view in views)


def gaussians_of(state: TrainingState) -> GaussianModel:
    """Return the model as a GaussianModel; `begin` has checked its type."""
    assert isinstance(state.model, GaussianModel)
    return state.model


@functools.cache
def _coefficients() -> Tensor:
    """[MAX_COPIES+1, MAX_COPIES+1] float64: C(n, j) (-1)^(j-1) / sqrt(j) at [j, n], 0 for j = 0 and j > n."""
    table = torch.zeros(MAX_COPIES + 1, MAX_COPIES + 1, dtype=torch.float64)
    for n in range(1, MAX_COPIES + 1):
        for j in range(1, n + 1):
            table[j, n] = math.comb(n, j) * (-1) ** (j - 1) / math.sqrt(j)
    return table


@torch.no_grad()
def shared_among(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Return opacity and scales of `copies` coincident Gaussians that together render like the given one.

    opacities   [M] in 0..1
    scales      [M,3] > 0, standard deviations
    copies      [M] int64 >= 1; above 51 it counts as 51

    Returns ([M], [M,3]), not clamped, in the dtype given: o' = 1 - (1 - o)^(1/n), so that n of them let as much light
    through, and scale * o / sum_{i=1..n} sum_{k=0..i-1} C(i-1,k) (-1)^k o'^(k+1) / sqrt(k+1), so that what they blend
    along a line through the centre stays. Summed over i first, C(i-1,k) becomes C(n,k+1). In float64: the signs
    alternate. Source: arXiv 2404.09591.
    """
    n = copies.clamp(1, MAX_COPIES)
    before = opacities.double()
    after = -torch.expm1(torch.log1p(-before) / n)
    table = _coefficients().to(opacities.device)
    total = torch.zeros_like(after)
    for j in range(MAX_COPIES, 0, -1):  # Horner; the sum has no term of power 0
        total = (total + table[j].index_select(0, n)) * after
    # Of a Gaussian without opacity nothing is seen: its scale may stay (0 / 0).
    factor = torch.where(total > 0, before / total, 1.0)
    return after.to(opacities), (scales.double() * factor[:, None]).to(scales)


def draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return rows [count] int64, sampled with replacement in proportion to `weights` [N] >= 0.

    The random numbers are drawn on the CPU, so that every device draws the same rows.
    """
    at = torch.rand(count, generator=generator, dtype=torch.float64)
    # On a GPU the sum of a scan has one order only in torch's slow form, of N x N terms.
    place = "cpu" if torch.are_deterministic_algorithms_enabled() else weights.device
    cumulated = weights.to(place, torch.float64).cumsum(0)
    rows = torch.searchsorted(cumulated, at.to(place) * cumulated[-1], right=True).clamp_max(len(weights) - 1)
    return rows.to(weights.device)


@torch.no_grad()
def relocate(
    model: GaussianModel, rows: SplatOptimizer, generator: torch.Generator, *, min_opacity: float = 0.005
) -> int:
    """Move every Gaussian with opacity <= `min_opacity` onto a live one; return how many moved.

    Targets are sampled in proportion to opacity; each shares its opacity and scales with its arrivals (`shared_among`).
    Adam moments of the targets become zero, those of moved Gaussians stay. With a second moment of zero, the tiny
    gradients of the regularisers would make steps of several learning rates until a view shows the Gaussian, so that
    it dies again. If none is dead, or none is alive, nothing happens.
    """
    opacities = model.opacities
    is_dead = opacities <= min_opacity
    dead, alive = is_dead.nonzero().squeeze(1), (~is_dead).nonzero().squeeze(1)
    if dead.numel() == 0 or alive.numel() == 0:
        return 0
    sources, arrivals = _shared(model, alive[draw(opacities[alive], dead.numel(), generator)], min_opacity)
    index, values = sources
    rows.set_rows(
        model,
        torch.cat([dead, index]),
        {name: torch.cat([arrivals[name], values[name]]) for name in arrivals},
        forget=index,
    )
    return dead.numel()


@torch.no_grad()
def grow(
    model: GaussianModel,
    rows: SplatOptimizer,
    generator: torch.Generator,
    *,
    cap: int = 1_000_000,
    growth: float = 0.05,
    min_opacity: float = 0.005,
) -> int:
    """Copy Gaussians sampled by opacity until there are min(cap, floor((1 + growth) N)); return how many were added.

    Each copied one shares its opacity and scales with its copies and keeps its Adam moments, those of the copies are
    zero. A model that is larger than the cap stays as it is.
    """
    # Paper's code: the moments of the sources become zero; 0.4 dB less on a room with cameras all round, see README.
    count = min(cap, math.floor((1 + growth) * model.num_rows)) - model.num_rows
    if count <= 0:
        return 0
    (index, values), arrivals = _shared(model, draw(model.opacities, count, generator), min_opacity)
    rows.set_rows(model, index, values, forget=index[:0])
    rows.append_rows(model, arrivals)
    return count


def _shared(
    model: GaussianModel, picks: Tensor, min_opacity: float
) -> tuple[tuple[Tensor, dict[str, Tensor]], dict[str, Tensor]]:
    """((rows that were picked, their new values), the values of each pick): all parameters, by name."""
    index, inverse, counts = torch.unique(picks, return_inverse=True, return_counts=True)
    opacities, scales = shared_among(model.opacities[index], model.scales[index], counts + 1)
    values = {
        name: parameter.detach()[index]
        for name, parameter in model.named_parameters(recurse=False)
        if name in model.ROWS
    }
    most = 1 - torch.finfo(opacities.dtype).eps
    values["opacity_logits"] = torch.logit(opacities.clamp(min_opacity, most))
    values["log_scales"] = scales.log()
    return (index, values), {name: value[inverse] for name, value in values.items()}


@torch.no_grad()
def add_noise(
    model: GaussianModel,
    generator: torch.Generator,
    *,
    lr: float,
    strength: float = 5e5,
    min_opacity: float = 0.005,
) -> None:
    """Shift every mean, in place, by lr * strength * sigmoid(-100 (opacity - min_opacity)) * Sigma z, z ~ N(0, I).

    generator   on the model's device: a million normal numbers per step are not to travel
    lr          step size of the means, world units

    Sigma = R S^2 R^T, and R^T z is as normal as z: one rotation suffices.
    """
    scales = model.scales
    noise = torch.randn(scales.shape, generator=generator, dtype=scales.dtype, device=scales.device)
    amount = torch.sigmoid(STEEPNESS * (min_opacity - model.opacities)) * (lr * strength)  # [N]
    model.means.add_(rotate(model.quats, scales.square().mul_(noise).mul_(amount[:, None])))
