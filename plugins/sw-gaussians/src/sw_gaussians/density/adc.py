"""Adaptive density control of 3DGS: clone and split where screen-space gradients are high, prune, reset opacities.

Source: 3DGS (arXiv 2308.04079), section 5, following the authors' code where it differs from the paper.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar

import torch
from pydantic import Field

from splatwizard_core.api import DensityControl, EmptyModel, GaussianModel, Params, SplatOptimizer
from sw_gaussians.density.splitting import split_children
from sw_gaussians.start import logit
from sw_gaussians.statistics import STATISTICS, collect_statistics

if TYPE_CHECKING:
    from splatwizard_core.api import RenderResult, StageContext, TrainingState
    from splatwizard_core.training.density import DensityReport, DensityTask

SPLIT_CHILDREN = 2
"""Factor that divides the scales of the two children of a split."""


class GradientSettings(Params):
    """Shared settings of controls that densify by screen-space gradients and reset opacities."""

    start: int = Field(500, ge=0, description="first step that densifies (authors' code: 600)")
    stop: int = Field(15_000, ge=0, description="no densification, statistics or opacity reset from this step on")
    interval: int = Field(100, ge=1, description="steps between densifications")
    grad_threshold: float = Field(
        2e-4, gt=0, description="mean screen-space gradient that densifies, NDC units (with absgrad about 8e-4)"
    )
    percent_dense: float = Field(
        0.01, gt=0, description="largest scale up to which a Gaussian is cloned, above it split; times the scene extent"
    )
    min_opacity: float = Field(0.005, ge=0, lt=1, description="Gaussians fainter than this are pruned")
    reset_interval: int = Field(3_000, ge=1, description="steps between opacity resets")
    reset_opacity: float = Field(0.01, gt=0, lt=1, description="opacity after a reset, at most")
    white_reset: int = Field(500, ge=0, description="step of an extra reset on a white background; 0: none")


class AdaptiveSettings(GradientSettings):
    """Settings of adaptive density control. Defaults are those of the Splatwizard paper."""

    world_prune: float = Field(
        0.1, gt=0, description="larger Gaussians are pruned once the first reset is past; times the scene extent"
    )
    prune_screen_px: float | None = Field(
        None, gt=0, description="Gaussians with a larger radius on screen are pruned, px; unset: never, as published"
    )
    absgrad: bool = Field(False, description="sum absolute pixel gradients (AbsGS); raise grad_threshold with it")
    revised_opacity: bool = Field(False, description="children of a split get 1 - sqrt(1 - opacity)")


class AdaptiveDensityControl(DensityControl):
    """3DGS density control until half time: densification every 100 steps, opacity reset every 3,000."""

    Settings: ClassVar[type[GradientSettings]] = AdaptiveSettings
    white = False  # known when a training begins; a plan can be printed without a scene

    @property
    def rounds(self) -> range:
        return range(self.settings.start, self.settings.stop, self.settings.interval)

    @property
    def until(self) -> int:
        return int(self.settings.stop)

    def needs(self, step: int) -> frozenset[str]:
        return frozenset({"absgrad" if self.settings.absgrad else "grad2d"})

    def begin(self, state: StageContext) -> None:
        self.white = state.scene.protocol.background == "white"

    def after_backward(self, state: TrainingState, result: RenderResult) -> None:
        assert isinstance(state.model, GaussianModel)
        collect_statistics(state.model, result)

    def post_tasks(self) -> Iterable[DensityTask]:
        yield "collect gradient statistics", range(self.until), self.after_backward
        yield "prune and densify", self.rounds, self.adjust
        yield from self.resets()

    def resets(self) -> Iterable[DensityTask]:
        """Return the steps at which opacities are reset."""
        settings = self.settings
        if self.white and 0 < settings.white_reset < settings.stop:
            # Against white, faint Gaussians in empty space cost nothing at first and hide the object later.
            yield "reset opacity (white background)", settings.white_reset, self.reset
        yield "reset opacity", range(0, settings.stop, settings.reset_interval), self.reset

    def reset(self, state: TrainingState) -> None:
        """Reset opacities."""
        assert isinstance(state.model, GaussianModel)
        reset_opacity(state.model, state.optimizer, ceiling=self.settings.reset_opacity)

    def adjust(self, state: TrainingState) -> DensityReport:
        settings, model = self.settings, state.model
        assert isinstance(model, GaussianModel)
        return densify_and_prune(
            model,
            state.optimizer,
            step=state.step,
            extent=state.scene.extent,
            grad_threshold=settings.grad_threshold,
            percent_dense=settings.percent_dense,
            min_opacity=self.min_opacity(state.optimizer.lr("opacity_logits")),
            world_prune=settings.world_prune,
            size_rules_after=self.steps(settings.reset_interval),
            prune_screen_px=settings.prune_screen_px,
            revised_opacity=settings.revised_opacity,
        )

    def steps(self, steps: int) -> int:
        """Scale a step count of the full schedule to this, possibly shortened, run."""
        found = self.when(steps)
        assert isinstance(found, int)
        return found

    def min_opacity(self, lr: float) -> float:
        """Return the opacity below which Gaussians are pruned, low enough to be exceeded again after a reset.

        lr      step size of the opacity logits

        2DGS prunes below 0.05, 33 steps of Adam from an opacity of 0.01, and its published plan leaves 100. In a plan
        that is scaled down to fewer the threshold is below the reset: else nothing would survive it.
        """
        plan = self.settings
        has_resets = plan.reset_interval < plan.stop or (self.white and 0 < plan.white_reset < plan.stop)
        way = logit(plan.min_opacity) - logit(plan.reset_opacity) if plan.min_opacity > 0 else 0.0
        if has_resets and self.steps(plan.interval) * lr < way:
            return float(min(plan.min_opacity, plan.reset_opacity / 2))
        return float(plan.min_opacity)


@torch.no_grad()
def densify_and_prune(
    model: GaussianModel,
    rows: SplatOptimizer,
    *,
    step: int,
    extent: float,
    grad_threshold: float = 2e-4,
    percent_dense: float = 0.01,
    min_opacity: float = 0.005,
    world_prune: float = 0.1,
    size_rules_after: int = 3000,
    prune_screen_px: float | None = None,
    revised_opacity: bool = False,
) -> dict[str, int]:
    """Clone small and split large Gaussians with a high mean screen-space gradient; prune transparent and huge ones.

    extent              E, world units: scale of the two size thresholds
    grad_threshold      NDC units per view (`>=`)
    percent_dense       largest scale <= percent_dense * E is cloned, above it split
    min_opacity         below it a Gaussian is pruned, 0..1
    world_prune         largest scale > world_prune * E is pruned, but only at steps after `size_rules_after`
    prune_screen_px     pruned if its largest radius since the last densification exceeds this, under the same
                        condition; None (as in the published evaluation): never
    revised_opacity     children of a split get 1 - sqrt(1 - opacity), so that the pair is as opaque as the parent

    Order of rows afterwards: survivors in their old order, clones, first children, second children. All three
    statistics start again at zero. Returns how many were "cloned", "split" and "pruned". Raises EmptyModel if nothing
    is left.
    """
    n = model.num_rows
    mean_gradient = (model.grad_accum / model.denom).nan_to_num_(nan=0.0)  # never seen: 0 / 0
    largest = model.scales.amax(dim=1)  # [N]
    hot = mean_gradient >= grad_threshold
    small = largest <= percent_dense * extent
    cloned = (hot & small).nonzero().squeeze(1)  # [C]
    parents = (hot & ~small).nonzero().squeeze(1)  # [P]

    doomed = torch.zeros(n, dtype=torch.bool, device=hot.device)
    if prune_screen_px is not None and step > size_rules_after:
        doomed = model.max_radii2d > prune_screen_px
    doomed[parents] = True

    children = split_children(model, parents, SPLIT_CHILDREN)
    if revised_opacity:
        opacity = torch.sigmoid(children["opacity_logits"])
        children["opacity_logits"] = torch.logit(1 - (1 - opacity).sqrt(), eps=1e-6)
    new_rows = {
        name: torch.cat([getattr(model, name).detach()[cloned], children[name]])  # [C + 2P, ...]
        for name, _ in model.named_parameters(recurse=False)
        if name in model.ROWS
    }
    count = cloned.numel() + SPLIT_CHILDREN * parents.numel()
    if count:
        rows.append_rows(model, new_rows)
        doomed = torch.cat([doomed, doomed.new_zeros(count)])
    for name in STATISTICS:
        getattr(model, name).zero_()

    doomed |= model.opacities < min_opacity
    if step > size_rules_after:
        doomed |= model.scales.amax(dim=1) > world_prune * extent
    kept = int((~doomed).sum())
    if kept == 0:
        raise EmptyModel(step)
    rows.keep_rows(model, ~doomed)
    return {"cloned": cloned.numel(), "split": parents.numel(), "pruned": n + count - kept - parents.numel()}


@torch.no_grad()
def reset_opacity(model: GaussianModel, rows: SplatOptimizer, *, ceiling: float = 0.01) -> None:
    """Clamp every opacity to at most `ceiling`; zero the Adam moments of the opacities, keep their step counter."""
    rows.replace(model, "opacity_logits", model.opacity_logits.detach().clamp_max(logit(ceiling)))
