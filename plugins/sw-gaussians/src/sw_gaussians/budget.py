"""Density control with a budget: which Gaussians get company is drawn by a score, how many follows from two bounds.

Functions on a model and the optimizer that edits its rows; `fast_tasks` makes schedule tasks of them.
Sources: LiteGS (arXiv 2503.01199) for the draw without a threshold, the children and the halving; the bound by what
plain density control would do is our own.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatwizard_core.api import EmptyModel, GaussianModel, SplatOptimizer
from sw_gaussians import fragments
from sw_gaussians.density import DensityReport, split_children
from sw_gaussians.morton import morton_order

CHILD_SHRINK = 1.6
"""Scales of a child of a large Gaussian are divided by this, as those of two children are in 3DGS."""
OPACITY_FLOOR = 1 / 128
"""Opacity that halving leaves at least."""
SCORES = ("opacity_variance", "gradient")
"""By what the draw is weighted."""


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
    """Return how many Gaussians there should be at a step: from `start` at `first` to `cap` at `last`, linearly."""
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
    wanted: Tensor | None = None,
) -> DensityReport:
    """Prune what is not needed, and give as many Gaussians a neighbour as the budget and the evidence allow.

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
    wanted          [N] bool: only these may get a neighbour, and only they count for `growth` (`veto.ViewEvidence`);
                    None: all

    Order of rows otherwise: survivors, copies, children. Statistics start again at zero.
    Raises EmptyModel if nothing is left, ValueError for a score that is none, or whose buffer the model lacks.
    """
    if score not in SCORES:
        raise ValueError(f"score '{score}' is none of {', '.join(SCORES)}")
    if score == "opacity_variance" and fragments.BUFFER not in model.ROWS:
        raise ValueError(
            'score="opacity_variance" needs a model with the buffer of sw_gaussians.fragments.add_buffer, which the '
            'task collect_opacity_gradients fills: give it one, or set score="gradient"'
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
    barred = doomed if wanted is None else doomed | ~wanted
    count = max(target - n, 1) + pruned
    if growth > 0:
        evidence = mean_gradient >= grad_threshold
        if wanted is not None:
            evidence &= wanted
        count = min(count, round(growth * int(evidence.sum())))
    count = min(count, n - int(barred.sum()))
    picks = draw_distinct(scores.masked_fill(barred, 0.0), count, model.next_split_generator())
    picks = picks[~barred[picks]]
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
    for name in ("grad_accum", "denom", "max_radii2d", fragments.BUFFER):
        if name in model.ROWS:
            getattr(model, name).zero_()
    return DensityReport(cloned=len(copied), split=len(parents), pruned=pruned, total=model.num_rows)


@torch.no_grad()
def halve_opacity(model: GaussianModel, rows: SplatOptimizer, *, floor: float = OPACITY_FLOOR) -> None:
    """Set every opacity o to max(o / 2, floor), and let Adam start afresh for all parameters.

    With its moments the step counters go too: kept, the first step after would be 3.2 times the learning rate.
    Source: LiteGS (arXiv 2503.01199).
    """
    rows.replace(model, "opacity_logits", torch.logit((model.opacities / 2).clamp_min(floor)))
    rows.states.clear()
