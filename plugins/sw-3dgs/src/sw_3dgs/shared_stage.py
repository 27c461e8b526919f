"""The stage of 3DGS with several views in an update, and several GPUs that draw them.

A process draws every `gpus`-th view of the training. Gradients are added up, in each process and then over all of them,
and each makes the same update, so that models, moments and random streams have equal bits everywhere. What density
control has seen is added up where it decides. Plans and steps are counted in views, so that an epoch stays an epoch.

Source of the step sizes: On Scaling Up 3D Gaussian Splatting Training (arXiv 2406.18533). With B views in an update
learning rates are sqrt(B) times as large, and Adam forgets as much in a view as before: beta^B.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from sw_gaussians.config import LearningRates
from sw_gaussians.late_batches import LAST_PRIORITY, SumViews
from sw_gaussians.stage import ThreeDGSStage
from sw_parallel.followers import followed
from sw_parallel.ranks import Ranks

from splatwizard_core.api import CameraSampler, ConfigError, ParamGroup, SplatOptimizer

if TYPE_CHECKING:
    import torch
    from sw_gaussians.pictures import PictureSizes

    from splatwizard_core.api import (
        DensityControl,
        OptimizationParams,
        PipelineParams,
        PluginManager,
        RenderResult,
        Scene,
        Scheduler,
        SplatModel,
        TrainingState,
        View,
    )
    from splatwizard_core.training.density import DensityReport
    from sw_3dgs.config import ThreeDGSConfig

LARGEST = ("max_radii2d",)
"""Statistics of Gaussians that are maxima over views; all others are sums."""
ALONE = Ranks()
"""Of a process that trains alone, or has not started the others yet."""


def shared_stage(config: ThreeDGSConfig, plugins: PluginManager, ranks: Ranks = ALONE) -> SharedStage:
    """Return the stage of a process of this training; `ranks` of more than one: it goes on with these."""
    return SharedStage(config, config.density.load(plugins), pictures=config.pictures.load(plugins), ranks=ranks)


class SharedStage(ThreeDGSStage):
    """Training of 3DGS with `opt.batch` views in an update, drawn by `opt.gpus` processes.

    ranks   of this process; of count 1 in the process of the run, which starts the others before its first step
    """

    def __init__(
        self,
        opt: ThreeDGSConfig,
        control: DensityControl,
        *,
        pictures: PictureSizes | None = None,
        ranks: Ranks = ALONE,
    ) -> None:
        if opt.batch % opt.gpus:
            raise ConfigError(
                f"gpus={opt.gpus} cannot share a batch of {opt.batch} views evenly: make it a multiple", key="batch"
            )
        for key, is_on in (
            ("sparse_adam=true", opt.sparse_adam),
            ("fused_updates=true", bool(opt.fused_updates)),
            ("fast.late_views", opt.fast.late_views > 1),
        ):
            if is_on:
                raise ConfigError(f"batch={opt.batch} makes an update of several views, {key} of one: leave out one")
        super().__init__(opt.model_copy(update={"lr": raised(opt.lr, opt.batch)}), control, pictures=pictures)
        self.batch, self.views_per_step, self.ranks, self._given = opt.batch, opt.gpus, ranks, opt

    @contextlib.contextmanager
    def running(self, state: TrainingState) -> Iterator[None]:
        """Have the other processes train along while this one, the first, does."""
        if self.views_per_step == 1:
            yield
            return
        if state.stage is not self or self.extra_tasks:
            raise ConfigError(
                f"gpus={self.views_per_step} is for the plan of 3dgs alone: what a method or a configuration adds "
                "to it does not reach the other processes. Leave it out; a scene to start from takes pretrained.gpus",
                key="gpus",
            )
        make_stage = functools.partial(shared_stage, self._given)
        with followed(state, make_stage, self.views_per_step) as self.ranks:
            assert isinstance(state.optimizer, SummingAdam)
            state.optimizer.ranks = self.ranks
            assert isinstance(state.sampler, SharedSampler)
            yield

    def create_sampler(self, scene: Scene, generator: torch.Generator) -> CameraSampler:
        return SharedSampler(super().create_sampler(scene, generator), self.ranks.rank, self.views_per_step)

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        groups = super().create_optimizer(model, scene).groups.values()
        self._optimizer = SummingAdam(model, [slowed(group, self.batch) for group in groups], self.ranks)
        return self._optimizer

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_post_task(scheduler, ppl, opt)
        in_turn = self.batch // self.views_per_step
        if in_turn > 1:
            sums = SumViews(views=in_turn, first=1)  # views after the last whole batch are lost
            scheduler.register_task(range(self.iterations + 1), sums, priority=LAST_PRIORITY, name="sum views")

    def adjust(self, state: TrainingState) -> DensityReport:
        model = state.model
        statistics = {name: buffer for name, buffer in model.named_buffers() if name in model.ROWS}
        self.ranks.add_up([buffer for name, buffer in statistics.items() if name not in LARGEST])
        self.ranks.keep_largest([buffer for name, buffer in statistics.items() if name in LARGEST])
        return super().adjust(state)


def raised(lr: LearningRates, batch: int) -> LearningRates:
    """Return learning rates for so many views in an update."""
    rates = ("position_init", "position_final", "sh_dc", "sh_rest", "opacity", "scales", "quats")
    return lr.model_copy(update={name: getattr(lr, name) * math.sqrt(batch) for name in rates})


def slowed(group: ParamGroup, batch: int) -> ParamGroup:
    """Return a group whose moments forget as much in a view, with so many of them in an update."""
    first, second = group.betas
    return ParamGroup(group.name, group.lr, group.eps, (first**batch, second**batch))


class SharedSampler(CameraSampler):
    """Draws the views of all processes, in the same order in each, and hands out this one's.

    inner   draws
    """

    def __init__(self, inner: CameraSampler, rank: int, count: int) -> None:
        self.inner, self.rank, self.count = inner, rank, count
        self.views, self.generator = inner.views, inner.generator

    def next(self, step: int) -> View:
        return [self.inner.next(step) for _ in range(self.count)][self.rank]

    def state_dict(self) -> dict[str, object]:
        return self.inner.state_dict()

    def load_state_dict(self, state: dict[str, object]) -> None:
        self.inner.load_state_dict(state)


class SummingAdam(SplatOptimizer):
    """Dense Adam on gradients that are summed over all processes; the factor to their mean cancels out in it."""

    def __init__(self, model: SplatModel, groups: list[ParamGroup], ranks: Ranks) -> None:
        super().__init__(model, groups)
        self.ranks = ranks

    def step(self, result: RenderResult | None = None) -> None:
        with_gradients = [p for p in self.model.parameters() if p.grad is not None]
        for param in with_gradients:
            assert param.grad is not None
            param.grad = param.grad.contiguous()
        self.ranks.add_up([p.grad for p in with_gradients if p.grad is not None])
        super().step(result)
