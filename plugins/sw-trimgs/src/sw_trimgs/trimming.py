"""Schedule task: the Gaussians of least contribution go, by a quantile of any pruner's scores."""

from __future__ import annotations

import torch
from sw_gaussians.finetune.pruning import scores_of
from torch import Tensor

from splatwizard_core.api import (
    CameraIterator,
    EmptyModel,
    OptimizationParams,
    Pruner,
    Rasterizer,
    Scene,
    SplatModel,
    SplatOptimizer,
    TaskLog,
)


def quantile(values: Tensor, level: float) -> Tensor:
    """Scalar, the `level`-quantile (0..1) of `values` [N], N > 0, linear between neighbours.

    As torch.quantile, which refuses more than 2^24 values.
    """
    ordered = values.sort().values
    at = level * (len(values) - 1)
    low = int(at)
    high = min(low + 1, len(values) - 1)
    return ordered[low] + (at - low) * (ordered[high] - ordered[low])


def trimmed(scores: Tensor, ratio: float, *, unseen: bool) -> Tensor:
    """[N] bool, True for what goes: a score below the quantile.

    scores  [N] >= 0, -inf for what no view shows: that counts as 0
    ratio   p, 0..1: where all differ about p N go, of equal lowest ones none
    unseen  what no view shows goes too, where more than the share p is unseen and the quantile is 0
    """
    seen = torch.isfinite(scores)
    values = torch.where(seen, scores, 0)
    goes = values < quantile(values, ratio)
    return goes | ~seen if unseen else goes


class Trim:
    """Schedule task: removes what scores below a quantile; says how many ("trimmed").

    pruner      whose scores, 0 or more
    ratio       p of the quantile, 0..1
    first       step of the first trim, which leaves what no view shows if that is more than the quantile takes; every
                later one removes it too. None: none removes it

    It does nothing at the last step of a stage, which makes no update. Raises EmptyModel if nothing would be left.
    """

    def __init__(self, pruner: Pruner, ratio: float, *, first: int | None = None) -> None:
        self.pruner, self.ratio, self.first = pruner, ratio, first

    def __call__(
        self,
        model: SplatModel,
        optimizer: SplatOptimizer,
        cameras: CameraIterator,
        rasterizer: Rasterizer,
        scene: Scene,
        opt: OptimizationParams,
        step: int,
        log: TaskLog,
    ) -> None:
        if step >= opt.iterations:
            return
        scores = scores_of(self.pruner, model, cameras, rasterizer, scene)
        goes = trimmed(scores, self.ratio, unseen=self.first is not None and step > self.first)
        before, gone = model.num_rows, int(goes.sum())
        if gone == before:
            raise EmptyModel(step)
        optimizer.keep_rows(model, ~goes)
        log.say(f"trimmed {gone:,} of {before:,} Gaussians, {before - gone:,} left")
        log.scalar("trimmed", gone)
