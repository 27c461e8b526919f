"""Schedule tasks of 3DGS, registered by name for stages with their own plan.

Tasks without settings are plain functions; the others are made with their settings as keywords, so that a
method of another package needs no class of ours: `plugins.tasks.load("prune-and-densify")(grad_threshold=4e-4)`.

At the last step of a stage the two tasks that disturb a picture (densification, opacity reset) do nothing, as
`control_tasks` says.
"""

from splatwizard_core.api import GaussianModel, OptimizationParams, Scene, SplatOptimizer, TaskLog
from sw_gaussians.density import adc
from sw_gaussians.stage import UpdateLearningRate, increase_sh_degree

__all__ = ["PruneAndDensify", "ResetOpacity", "UpdateLearningRate", "increase_sh_degree"]


class PruneAndDensify:
    """Clones, splits and prunes (sw_gaussians.density.adc.densify_and_prune).

    size_rules_after    steps before which nothing is pruned for its size: the first reset interval
    The other settings are those of `densify_and_prune`. Curves: "cloned", "split", "pruned", numbers of Gaussians.
    """

    def __init__(
        self,
        *,
        grad_threshold: float = 2e-4,
        percent_dense: float = 0.01,
        min_opacity: float = 0.005,
        world_prune: float = 0.1,
        size_rules_after: int = 3_000,
        prune_screen_px: float | None = None,
        revised_opacity: bool = False,
    ) -> None:
        self.settings = {
            "grad_threshold": grad_threshold,
            "percent_dense": percent_dense,
            "min_opacity": min_opacity,
            "world_prune": world_prune,
            "size_rules_after": size_rules_after,
            "prune_screen_px": prune_screen_px,
            "revised_opacity": revised_opacity,
        }

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
        report = adc.densify_and_prune(model, optimizer, step=step, extent=scene.extent, **self.settings)
        for name, count in report.items():
            log.scalar(name, count)


class ResetOpacity:
    """Clamps every opacity to at most `ceiling` and zeroes its Adam moments."""

    def __init__(self, *, ceiling: float = 0.01) -> None:
        self.ceiling = ceiling

    def __call__(self, model: GaussianModel, optimizer: SplatOptimizer, opt: OptimizationParams, step: int) -> None:
        if step < opt.iterations:
            adc.reset_opacity(model, optimizer, ceiling=self.ceiling)
