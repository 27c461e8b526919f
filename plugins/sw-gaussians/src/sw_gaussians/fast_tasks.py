"""Schedule tasks of fast training (budget densification, opacity halving, multi-view pruning).

Like `tasks`, they do nothing at the last step of a stage, since no update follows.
"""

from typing import Literal

import torch

from splatwizard_core.api import (
    EmptyModel,
    GaussianModel,
    OptimizationParams,
    PipelineParams,
    Rasterizer,
    Scene,
    SplatOptimizer,
    TaskLog,
)
from sw_gaussians.density import budget
from sw_gaussians.density.budget import Score
from sw_gaussians.multiview_pruning import draw_views, multiview_error_scores, normalized_scores


class DensifyToBudget:
    """Prunes and grows within a budget (sw_gaussians.density.budget.densify_to_budget).

    first, last     steps between which the budget rises linearly, from the start points of the scene to `cap`
    interval        steps between two calls; a Gaussian without a fragment is pruned only if that is a whole round of
                    the training views, or nearly
    The other settings are those of `densify_to_budget`. With the default score the model needs the buffer of
    `density.fragments.add_buffer`. Raises ValueError for settings outside their range.
    Curves: "cloned", "split", "pruned", numbers of Gaussians.
    """

    def __init__(
        self,
        *,
        first: int = 300,
        last: int = 8_000,
        interval: int = 250,
        cap: int = 1_000_000,
        growth: float = 1.0,
        score: Score = "opacity_variance",
        grad_threshold: float = 2e-4,
        percent_dense: float = 0.01,
        min_opacity: float = 0.005,
        morton: bool = False,
    ) -> None:
        if score not in budget.SCORES:
            raise ValueError(f"score '{score}' is none of {', '.join(budget.SCORES)}")
        for name, value, least in (("cap", cap, 1), ("growth", growth, 0), ("interval", interval, 1)):
            if value < least:
                raise ValueError(f"{name} is {value}: it must be at least {least}")
        self.first, self.last, self.interval, self.cap = first, last, interval, cap
        self.growth, self.score, self.grad_threshold = growth, score, grad_threshold
        self.percent_dense, self.min_opacity, self.morton = percent_dense, min_opacity, morton

    def __call__(
        self,
        model: GaussianModel,
        optimizer: SplatOptimizer,
        scene: Scene,
        opt: OptimizationParams,
        step: int,
        log: TaskLog,
    ) -> None:
        if step >= opt.iterations:
            return
        start = 0 if scene.points is None else len(scene.points)
        target = budget.linear_target(step, first=self.first, last=self.last, start=start, cap=self.cap)
        report = budget.densify_to_budget(
            model, optimizer, step=step, extent=scene.extent, target=target, growth=self.growth, score=self.score,
            grad_threshold=self.grad_threshold, percent_dense=self.percent_dense, min_opacity=self.min_opacity,
            prune_unused=1.1 * self.interval >= len(scene.train), morton=self.morton,
        )  # fmt: skip
        for name, count in report.items():
            log.scalar(name, count)


class HalveOpacity:
    """Halves every opacity, down to `floor`, and resets Adam's state (sw_gaussians.density.budget.halve_opacity)."""

    def __init__(self, *, floor: float = budget.OPACITY_FLOOR) -> None:
        self.floor = floor

    def __call__(self, model: GaussianModel, optimizer: SplatOptimizer, opt: OptimizationParams, step: int) -> None:
        if step < opt.iterations:
            budget.halve_opacity(model, optimizer, floor=self.floor)


class PruneByViews:
    """Removes Gaussians that are nearly transparent, or that cover badly rendered pixels in several views.

    views           training views sampled per call
    min_opacity     prune Gaussians with a lower opacity
    most            prune Gaussians whose score exceeds this, 0..1 (`multiview_pruning.normalized_scores`)
    lambda_dssim, padding   of the photometric loss that a view's pixels are weighted with

    Renders as in training, but on the scene background even if training uses random ones.
    Raises ValueError for less than one view, EmptyModel if nothing is left. Curve: "pruned", a number of Gaussians.
    Source: FastGS (arXiv 2511.04283), pruning after densification: 10 views, 0.1, 0.9.
    """

    def __init__(
        self,
        *,
        views: int = 10,
        min_opacity: float = 0.1,
        most: float = 0.9,
        lambda_dssim: float = 0.2,
        padding: Literal["same", "valid"] = "same",
    ) -> None:
        if views < 1:
            raise ValueError(f"views is {views}: it must be at least 1")
        self.views, self.min_opacity, self.most = views, min_opacity, most
        self.lambda_dssim, self.padding = lambda_dssim, padding

    def __call__(
        self,
        model: GaussianModel,
        optimizer: SplatOptimizer,
        scene: Scene,
        opt: OptimizationParams,
        step: int,
        log: TaskLog,
        rasterizer: Rasterizer,
        ppl: PipelineParams,
    ) -> None:
        if step >= opt.iterations:
            return
        with torch.no_grad():
            views = draw_views(scene.train, self.views, model.next_split_generator())
            scores = multiview_error_scores(
                model, views, rasterizer, scene.background.to(model.device), clamp=ppl.clamp_render,
                lambda_dssim=self.lambda_dssim, padding=self.padding,
            )  # fmt: skip
            stays = (model.opacities >= self.min_opacity) & (normalized_scores(scores) <= self.most)
            left, before = int(stays.sum()), model.num_rows
            if left == 0:
                raise EmptyModel(step)
            optimizer.keep_rows(model, stays)
        log.scalar("pruned", before - left)
