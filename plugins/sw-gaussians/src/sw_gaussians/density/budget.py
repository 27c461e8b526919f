"""Density control with a budget: Gaussians to densify are sampled by a score, their number has two upper bounds.

Sources: LiteGS (arXiv 2503.01199) for the draw without a threshold, the children and the halving; the bound by what
plain density control would do is our own.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from pydantic import Field
from torch import Tensor

from splatwizard_core.api import ConfigError, EmptyModel, GaussianModel, SplatOptimizer
from sw_gaussians.density import fragments
from sw_gaussians.density.adc import AdaptiveDensityControl, GradientSettings
from sw_gaussians.density.splitting import split_children
from sw_gaussians.morton import morton_order
from sw_gaussians.statistics import STATISTICS

if TYPE_CHECKING:
    from splatwizard_core.api import RenderResult, SplatModel, StageContext, TrainingState
    from splatwizard_core.training.density import DensityReport, DensityTask

CHILD_SHRINK = 1.6
"""Factor that divides the scales of a split Gaussian's child, as in 3DGS."""
OPACITY_FLOOR = 1 / 128
"""Smallest opacity after halving."""
SCORES = ("opacity_variance", "gradient")
"""Scores that may weight the sampling."""


Score = Literal["opacity_variance", "gradient"]


class BudgetSettings(GradientSettings):
    """Settings of density control with a budget."""

    score: Score = Field(
        "opacity_variance",
        description="of the draw: variance of the opacity gradient (LiteGS), or screen-space gradient",
    )
    cap: int = Field(1_000_000, ge=1, description="Gaussians that the budget rises to, linearly until `stop`")
    growth: float = Field(
        1.0, ge=0, description="new Gaussians for each one over grad_threshold, at most; 0: the cap alone counts"
    )
    opacity: Literal["reset", "halve"] = Field(
        "reset", description="every reset_interval: reset: to at most reset_opacity; halve: by half"
    )
    morton: bool = Field(False, description="put Gaussians in Morton order at each densification")


class BudgetControl(AdaptiveDensityControl):
    """Schedule of adaptive density control; samples which Gaussians to densify, may halve opacities, not reset."""

    Settings: ClassVar[type[GradientSettings]] = BudgetSettings

    @property
    def by_variance(self) -> bool:
        """Whether the score is the variance of opacity gradients."""
        return bool(self.settings.score == "opacity_variance")

    def needs(self, step: int) -> frozenset[str]:
        # The variance of opacity gradients costs time in the backward pass.
        fragments_too = self.by_variance and step < self.steps(self.until)
        return frozenset({"grad2d", "fragment_grad"} if fragments_too else {"grad2d"})

    def begin(self, state: StageContext) -> None:
        super().begin(state)
        if self.by_variance:
            assert isinstance(state.model, GaussianModel)
            if state.model.NUM_SCALES != GaussianModel.NUM_SCALES:
                raise ConfigError(
                    "density.settings.score=opacity_variance sums opacity gradients over fragments, which no "
                    "rasterizer of surfels does: set density.settings.score=gradient",
                    key="density.settings.score",
                )
            fragments.add_buffer(state.model)

    def finish(self, model: SplatModel) -> None:
        fragments.drop_buffer(model)

    def post_tasks(self) -> Iterable[DensityTask]:
        yield "collect gradient statistics", range(self.until), self.after_backward
        if self.by_variance:
            yield "collect opacity gradients", range(self.until), self.collect_fragments
        yield "densify to budget", self.rounds, self.adjust
        if self.settings.opacity == "reset":
            yield from self.resets()
        else:
            yield "halve opacity", range(0, self.until, self.settings.reset_interval), self.halve

    def collect_fragments(self, state: TrainingState, result: RenderResult) -> None:
        """Collect opacity gradients."""
        assert isinstance(state.model, GaussianModel)
        fragments.collect_opacity_gradients(state.model, result)

    def halve(self, state: TrainingState) -> None:
        """Halve opacities."""
        assert isinstance(state.model, GaussianModel)
        halve_opacity(state.model, state.optimizer)

    def adjust(self, state: TrainingState) -> DensityReport:
        settings, scene, rounds = self.settings, state.scene, self.when(self.rounds)
        assert isinstance(state.model, GaussianModel)
        assert isinstance(rounds, range)
        start, last = 0 if scene.points is None else len(scene.points), rounds[-1]
        return densify_to_budget(
            state.model,
            state.optimizer,
            step=state.step,
            extent=scene.extent,
            target=linear_target(state.step, first=rounds.start, last=last, start=start, cap=settings.cap),
            growth=settings.growth,
            score=settings.score,
            grad_threshold=settings.grad_threshold,
            percent_dense=settings.percent_dense,
            min_opacity=self.min_opacity(state.optimizer.lr("opacity_logits")),
            # A Gaussian without a fragment is pruned only if a round is one of the training views, or nearly.
            prune_unused=1.1 * rounds.step >= len(scene.train),
            morton=settings.morton,
        )


def draw_distinct(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Draw rows without replacement, one after the other with probabilities in proportion to their weights.

    weights     [N] >= 0; rows of weight 0 come only when all others are drawn
    count       at most N
    generator   on the CPU, so that every device draws the same rows

    Returns [count] int64, ascending. Source: Efraimidis and Spirakis 2006, exponential races.
    """
    uniform = torch.rand(len(weights), generator=generator, dtype=torch.float64).to(weights.device)
    race = -torch.log1p(-uniform) / weights.double()  # weight 0: infinite, or 0 / 0
    race = race.nan_to_num_(nan=torch.inf, posinf=torch.finfo(torch.float64).max)
    return torch.topk(race, count, largest=False).indices.sort().values


def linear_target(step: int, *, first: int, last: int, start: int, cap: int) -> int:
    """Return the target number of Gaussians at a step: linear from `start` at `first` to `cap` at `last`."""
    share = 1.0 if step >= last else 0.0 if step <= first else (step - first) / (last - first)
    return int(start + (max(cap, start) - start) * share)


@torch.no_grad()
def densify_to_budget(
    model: GaussianModel,
    rows: SplatOptimizer,
    *,
    step: int,
    extent: float,
    target: int,
    growth: float = 1.0,
    score: str = "opacity_variance",
    grad_threshold: float = 2e-4,
    percent_dense: float = 0.01,
    min_opacity: float = 0.005,
    prune_unused: bool = True,
    morton: bool = False,
) -> dict[str, int]:
    """Prune, then clone or split as many Gaussians as the budget and the gradient statistics allow.

    extent          E, world units: scale of `percent_dense`
    target          Gaussians that there should be now; one more than are pruned may come where it is reached
    growth          new Gaussians for each one whose mean screen-space gradient reaches `grad_threshold`, which is what
                    plain density control adds; 0: the target alone decides
    score           "opacity_variance" (`fragments.BUFFER`), or "gradient", the mean screen-space gradient
    percent_dense   a Gaussian whose largest scale is at most this times E is copied; else it stays, and a child drawn
                    from it, smaller by 1.6, joins it
    min_opacity     Gaussians fainter than this are pruned
    prune_unused    also prune those that no fragment of all views was drawn from, though they were in view
    morton          put the rows in Morton order of the means

    Order of rows otherwise: survivors, copies, children. Statistics start again at zero. Returns how many were
    "cloned", "split" and "pruned".
    Raises EmptyModel if nothing is left, ValueError for a score that is none, or whose buffer the model lacks.
    """
    if score not in SCORES:
        raise ValueError(f"score '{score}' is none of {', '.join(SCORES)}")
    if score == "opacity_variance" and fragments.BUFFER not in model.ROWS:
        raise ValueError(
            'score="opacity_variance" needs a model with the buffer of sw_gaussians.density.fragments.add_buffer, '
            'which the task collect_opacity_gradients fills: give it one, or set score="gradient"'
        )
    n = model.num_rows
    mean_gradient = (model.grad_accum / model.denom).nan_to_num_(nan=0.0)  # never seen: 0 / 0
    doomed = model.opacities < min_opacity
    if score == "gradient":
        scores = mean_gradient
    else:
        sums = model.get_buffer(fragments.BUFFER)
        scores = fragments.opacity_variance(sums)
        if prune_unused:
            doomed |= (sums[:, 2] == 0) & (model.denom > 0)
    pruned = int(doomed.sum())
    if pruned == n:
        raise EmptyModel(step)
    count = max(target - n, 1) + pruned
    if growth > 0:
        count = min(count, round(growth * int((mean_gradient >= grad_threshold).sum())))
    count = min(count, n - pruned)
    picks = draw_distinct(scores.masked_fill(doomed, 0.0), count, model.next_split_generator())
    picks = picks[~doomed[picks]]
    is_small = model.scales[picks].amax(dim=1) <= percent_dense * extent
    copied, parents = picks[is_small], picks[~is_small]
    children = split_children(model, parents, 1, shrink=CHILD_SHRINK)
    rows.append_rows(
        model, {name: torch.cat([getattr(model, name).detach()[copied], children[name]]) for name in children}
    )
    stays = torch.cat([~doomed, doomed.new_ones(len(picks))]).nonzero().squeeze(1)
    if morton:
        stays = stays[morton_order(model.means.detach()[stays])]
    rows.keep_rows(model, stays)
    for name in (*STATISTICS, fragments.BUFFER):
        if name in model.ROWS:
            getattr(model, name).zero_()
    return {"cloned": len(copied), "split": len(parents), "pruned": pruned}


@torch.no_grad()
def halve_opacity(model: GaussianModel, rows: SplatOptimizer, *, floor: float = OPACITY_FLOOR) -> None:
    """Set every opacity o to max(o / 2, floor), and reset Adam's state of all parameters.

    With its moments the step counters go too: kept, the first step after would be 3.2 times the learning rate.
    Source: LiteGS (arXiv 2503.01199).
    """
    rows.replace(model, "opacity_logits", torch.logit((model.opacities / 2).clamp_min(floor)))
    rows.states.clear()
