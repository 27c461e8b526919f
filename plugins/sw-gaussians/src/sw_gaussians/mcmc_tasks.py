"""Schedule tasks of 3DGS-MCMC density control, registered by name for any method.

Random numbers come from a stream per step, so there is no generator state to save: a resumed run draws the same
numbers. Relocation does nothing at the last step, since no update follows.
"""

from splatwizard_core.api import GaussianModel, OptimizationParams, SplatOptimizer, TaskLog, stream
from sw_gaussians.density import mcmc


class Relocate:
    """Moves dead Gaussians onto live ones (sw_gaussians.density.mcmc.relocate); curve "relocated"."""

    def __init__(self, *, min_opacity: float = 0.005) -> None:
        self.min_opacity = min_opacity

    def __call__(
        self, model: GaussianModel, optimizer: SplatOptimizer, opt: OptimizationParams, step: int, log: TaskLog
    ) -> None:
        if step >= opt.iterations:
            return
        draws = stream(model.split_seed, f"relocate/{step}")
        moved = mcmc.relocate(model, optimizer, draws, min_opacity=self.min_opacity)
        log.scalar("relocated", moved)


class Grow:
    """Adds Gaussians up to a cap (sw_gaussians.density.mcmc.grow); curve "added"."""

    def __init__(self, *, cap: int = 1_000_000, growth: float = 0.05, min_opacity: float = 0.005) -> None:
        self.cap, self.growth, self.min_opacity = cap, growth, min_opacity

    def __call__(
        self, model: GaussianModel, optimizer: SplatOptimizer, opt: OptimizationParams, step: int, log: TaskLog
    ) -> None:
        if step >= opt.iterations:
            return
        draws = stream(model.split_seed, f"grow/{step}")
        added = mcmc.grow(
            model, optimizer, draws, cap=self.cap, growth=self.growth, min_opacity=self.min_opacity
        )  # fmt: skip
        log.scalar("added", added)


class AddNoise:
    """Adds noise to the means after each update (sw_gaussians.density.mcmc.add_noise).

    A pre task: it runs at the start of step s, after the update of step s - 1. Register it before "update lr", so that
    the learning rate is still that of step s - 1.
    """

    def __init__(self, *, strength: float = 5e5, min_opacity: float = 0.005) -> None:
        self.strength, self.min_opacity = strength, min_opacity

    def __call__(self, model: GaussianModel, optimizer: SplatOptimizer, opt: OptimizationParams, step: int) -> None:
        if not 1 < step < opt.iterations:  # before step 1 there was no update
            return
        draws = stream(model.split_seed, f"noise/{step}", model.means.device)
        mcmc.add_noise(
            model, draws, lr=optimizer.lr("means"), strength=self.strength, min_opacity=self.min_opacity
        )  # fmt: skip
