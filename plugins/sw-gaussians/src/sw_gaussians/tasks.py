"""The schedule tasks of 3DGS, for its stage and, by name, for other methods.

Tasks without settings are plain functions; the others are made with their settings as keywords, so that a
method of another package needs no class of ours: `plugins.tasks.load("prune-and-densify")(grad_threshold=4e-4)`.

At the last step of a stage the two tasks that disturb a picture (densification, opacity reset) do nothing: no update
follows that could repair it. A full run ends long after the last of both; a run that is cut short to a multiple of 100
would lose about 0.8 dB (lego, 7,000 steps), one cut to a multiple of 3,000 almost everything. Published figures of
short runs are taken before the densification of their last step, too.
"""

from collections.abc import Callable

from splatwizard_core.api import GaussianModel, OptimizationParams, Scene, SplatOptimizer, TaskLog
from sw_gaussians import density
from sw_gaussians.learning_rate import exponential_lr


class UpdateLearningRate:
    """Sets the step size of the means: exponential decay, times the scene extent.

    held    () -> steps at which it stays `init`, known when the pictures have been read; None: it falls from the start
    """

    def __init__(
        self,
        *,
        init: float = 1.6e-4,
        final: float = 1.6e-6,
        max_steps: int = 30_000,
        delay_steps: int = 0,
        delay_mult: float = 0.01,
        held: Callable[[], int] | None = None,
    ) -> None:
        self.init, self.final, self.max_steps, self.held = init, final, max_steps, held
        self.delay_steps, self.delay_mult = delay_steps, delay_mult

    def rate(self, step: int, extent: float) -> float:
        """The step size of the means at `step`, world units."""
        return extent * exponential_lr(
            step,
            init=self.init,
            final=self.final,
            max_steps=self.max_steps,
            delay_steps=self.delay_steps,
            delay_mult=self.delay_mult,
            held=0 if self.held is None else self.held(),
        )

    def __call__(self, optimizer: SplatOptimizer, scene: Scene, step: int) -> None:
        optimizer.set_lr("means", self.rate(step, scene.extent))


def increase_sh_degree(model: GaussianModel) -> None:
    """Activate one more SH band."""
    density.increase_sh_degree(model)


class PruneAndDensify:
    """Clones, splits and prunes (sw_gaussians.density.densify_and_prune).

    size_rules_after    steps before which nothing is pruned for its size: the first reset interval
    pause_after_reset   steps after a multiple of `reset_interval` at which nothing happens; 0: no pause
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
        reset_interval: int = 3_000,
        pause_after_reset: int = 0,
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
        self.reset_interval, self.pause_after_reset = reset_interval, pause_after_reset

    def __call__(
        self,
        model: GaussianModel,
        optimizer: SplatOptimizer,
        scene: Scene,
        opt: OptimizationParams,
        step: int,
        log: TaskLog,
    ) -> None:
        paused = step >= self.reset_interval and step % self.reset_interval < self.pause_after_reset
        if paused or step >= opt.iterations:
            return
        report = density.densify_and_prune(model, optimizer, step=step, extent=scene.extent, **self.settings)
        for name in ("cloned", "split", "pruned"):
            log.scalar(name, getattr(report, name))


class ResetOpacity:
    """Lowers every opacity to at most `ceiling` and clears its Adam moments."""

    def __init__(self, *, ceiling: float = 0.01) -> None:
        self.ceiling = ceiling

    def __call__(self, model: GaussianModel, optimizer: SplatOptimizer, opt: OptimizationParams, step: int) -> None:
        if step < opt.iterations:
            density.reset_opacity(model, optimizer, ceiling=self.ceiling)
