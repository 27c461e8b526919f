"""Pruning by score: remove a share of the primitives by the scores of any registered pruner."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor

from splatwizard_core.api import (
    CameraIterator,
    EmptyModel,
    Pruner,
    Rasterizer,
    Scene,
    ShapeError,
    SplatModel,
    SplatOptimizer,
    TaskLog,
)

CountRule = Literal["exact", "official"]


def removal_count(n: int, fraction: float) -> int:
    """Return floor(fraction n), the number of primitives to remove, robust to binary rounding of `fraction` (0..1).

    0.3 of 10 is 3, though 0.3 * 10 may come out below 3 in floating point.
    """
    return min(n, math.floor(fraction * n + 1e-9))


def lowest(scores: Tensor, count: int) -> Tensor:
    """Return [N] bool, True for the `count` lowest `scores` [N]; ties go to the first rows. -inf is the lowest.

    Raises ValueError for NaN.
    """
    if bool(torch.isnan(scores).any()):
        raise ValueError("a score is not a number")
    order = torch.sort(scores, stable=True).indices
    doomed = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
    doomed[order[:count]] = True
    return doomed


def up_to(scores: Tensor, fraction: float) -> Tensor:
    """Return [N] bool: True where a score is at most the one at index int(fraction (N - 1)) of the sorted `scores` [N].

    How the authors of PUP 3D-GS and of LightGaussian count: one more than the fraction, and all of many equal ones
    (those that no view shows).
    """
    if len(scores) == 0:
        return torch.zeros(0, dtype=torch.bool, device=scores.device)
    return scores <= torch.sort(scores).values[int(fraction * (len(scores) - 1))]


class PruneByScore:
    """Schedule task: score every primitive over the training views and remove the lowest; curve "pruned".

    pruner      whose scores
    fractions   share that goes, 0..1: of the count at that step. A number, or step -> number
    carry_grad  the survivors are still updated in this step; otherwise their gradient is gone with the old tensors,
                as in most published code
    count_rule  "exact": `removal_count` of the `lowest`; "official": `up_to`

    Gradients of the step stay what they are: scoring leaves them alone. Raises EmptyModel if nothing would be left.
    """

    def __init__(
        self,
        pruner: Pruner,
        fractions: float | Mapping[int, float],
        *,
        carry_grad: bool = False,
        count_rule: CountRule = "exact",
    ) -> None:
        self.pruner, self.fractions, self.carry_grad, self.count_rule = pruner, fractions, carry_grad, count_rule

    def __call__(
        self,
        model: SplatModel,
        optimizer: SplatOptimizer,
        cameras: CameraIterator,
        rasterizer: Rasterizer,
        scene: Scene,
        step: int,
        log: TaskLog,
    ) -> None:
        scores = scores_of(self.pruner, model, cameras, rasterizer, scene)
        before = model.num_rows
        doomed = self.doomed(scores, step)
        left = before - int(doomed.sum())
        if left == 0:
            raise EmptyModel(step)
        optimizer.keep_rows(model, ~doomed, carry_grad=self.carry_grad)
        log.say(f"removed {before - left:,} of {before:,} primitives, {left:,} left")
        log.scalar("pruned", before - left)

    def doomed(self, scores: Tensor, step: int) -> Tensor:
        """Return [N] bool: what goes at this step, by `scores` [N]."""
        fraction = self.fractions[step] if isinstance(self.fractions, Mapping) else self.fractions
        if self.count_rule == "official":
            return up_to(scores, fraction)
        return lowest(scores, removal_count(len(scores), fraction))


class PruneToCount(PruneByScore):
    """Schedule task: remove the lowest in several rounds, an equal share in each, until `count` primitives are left.

    steps   of the rounds, ascending; a round takes what is left to take by the ones from it on
    """

    def __init__(self, pruner: Pruner, steps: Sequence[int], count: int, *, carry_grad: bool = False) -> None:
        super().__init__(pruner, 0.0, carry_grad=carry_grad)
        self.steps, self.count = tuple(steps), count

    def doomed(self, scores: Tensor, step: int) -> Tensor:
        n, rounds = len(scores), sum(at >= step for at in self.steps)
        left = round(n * (self.count / n) ** (1 / rounds)) if n > self.count else n
        return lowest(scores, n - left)


@torch.no_grad()
def scores_of(
    pruner: Pruner, model: SplatModel, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene
) -> Tensor:
    """Return one score per row of the model, [N], rendered on the evaluation background.

    A pruner with `score_views` gets the views, pictures included; any other their cameras. Raises ShapeError or
    ValueError for what cannot be scores.
    """
    background = scene.background.to(model.device)
    score_views = getattr(pruner, "score_views", None)
    if score_views is not None:
        scores = score_views(model, cameras, rasterizer, background)
    else:
        scores = pruner.score(model, [view.camera for view in cameras], rasterizer, background)
    name = type(pruner).__name__
    if scores.shape != (model.num_rows,):
        raise ShapeError(f"pruner {name} gave scores {list(scores.shape)} for {model.num_rows} primitives")
    if bool(torch.isnan(scores).any()):
        raise ValueError(f"a score of pruner {name} is not a number")
    return scores
