"""The schedule tasks of fast training, for the stage of 3DGS and, by name, for other methods.

As those of `tasks`, they change nothing at the last step of a stage: no update follows that could repair it.
"""

from typing import Literal

from splatwizard_core.api import GaussianModel, OptimizationParams, Scene, SplatOptimizer, TaskLog
from sw_gaussians import budget

Score = Literal["opacity_variance", "gradient"]


class DensifyToBudget:
    """Prunes and grows within a budget (sw_gaussians.budget.densify_to_budget).

    first, last     steps between which the budget rises linearly, from the start points of the scene to `cap`
    interval        steps between two calls; a Gaussian without a fragment is pruned only if that is a whole round of
                    the training views, or nearly
    The other settings are those of `densify_to_budget`. With the default score the model needs the buffer of
    `fragments.add_buffer`. Raises ValueError for settings outside their range.
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
        for name in ("cloned", "split", "pruned"):
            log.scalar(name, getattr(report, name))


class HalveOpacity:
    """Halves every opacity, down to `floor`, and lets Adam start afresh (sw_gaussians.budget.halve_opacity)."""

    def __init__(self, *, floor: float = budget.OPACITY_FLOOR) -> None:
        self.floor = floor

    def __call__(self, model: GaussianModel, optimizer: SplatOptimizer, opt: OptimizationParams, step: int) -> None:
        if step < opt.iterations:
            budget.halve_opacity(model, optimizer, floor=self.floor)
