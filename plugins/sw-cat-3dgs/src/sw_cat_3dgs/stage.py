"""Training stage of CAT-3DGS: that of anchors with a rate, and the phases of the triplane and its spatial models."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from sw_anchors.coded_anchors import ENTROPY, QUANTIZED
from sw_anchors.phase_switch import PhaseSwitch
from sw_anchors.stage import CodedAnchorStage, Weighted

from splatwizard_core.api import CameraIterator, LossPack, Rasterizer, SplatOptimizer, TaskLog
from sw_cat_3dgs.config import FULL_RUN, CatConfig
from sw_cat_3dgs.fast import plane_graphs
from sw_cat_3dgs.model import CatAnchors, Trained

if TYPE_CHECKING:
    from torch import Tensor

    from splatwizard_core.api import (
        Camera,
        OptimizationParams,
        PipelineParams,
        RenderResult,
        Scene,
        Scheduler,
        SplatModel,
        StageContext,
        View,
    )

log = logging.getLogger(__name__)

WITHOUT_PICTURES = "spatial models", "nothing"
"""Values of `CatAnchors.trained` in steps whose loss looks at no picture."""


class CatStage(CodedAnchorStage):
    """One stage of 40,000 steps; the README says what is trained when.

    "cam mask" of the plan are the view weights of the masks, "anchor bound" the 16-bit lattice of the positions.
    """

    name = "cat-3dgs"
    opt: CatConfig

    def begin(self, context: StageContext) -> SplatModel:
        self.plane_draws = context.generator("triplane")
        self._cameras: list[Camera] | None = None
        return super().begin(context)

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        assert isinstance(model, CatAnchors)
        plane_graphs.release(model.context)
        return super().finish(model, scene)

    # Optimizer

    def learning_rates(self, step: int) -> Mapping[str, float]:
        rates, phases = self.opt.context_lr, self.opt.phases
        since_triplane, since_warmup = step - self.at(phases.triplane), step - self.at(phases.warmup)
        network = self.decay(max(since_triplane, 0), rates.init, rates.final)
        return {
            **super().learning_rates(step),
            "context.triplane": network if since_triplane > 0 else rates.planes_init,
            "context.network": network,
            "context.slices": network,
            "context.arms": self.decay(since_warmup, rates.init, rates.final)
            if since_warmup > 0
            else rates.spatial_init,
        }

    # Plan

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        phases = self.opt.phases
        # All steps, also where lr.max_steps is less (BungeeNeRF): the context's rates start to decay late, and anchors
        # come and go until growth.stop.
        whole = range(max(FULL_RUN, self.opt.lr.max_steps, self.opt.growth.stop))
        scheduler.register_task(self.when(whole), self.update_lr)
        scheduler.register_task(self.when(whole), self.update_cam_mask)
        scheduler.register_task(1, self.update_anchor_bound)
        PhaseSwitch(self.at(phases.quantize), QUANTIZED).register(scheduler)
        scheduler.register_task(self.at(phases.triplane), self.update_anchor_bound)
        scheduler.register_task(self.at(phases.triplane), self.setup_triplane)
        PhaseSwitch(self.at(phases.triplane) + 1, ENTROPY).register(scheduler)
        if phases.rebound:
            scheduler.register_task(self.at(phases.warmup), self.update_anchor_bound)
        scheduler.register_task(self.at(phases.warmup), self.train_spatial_models)
        scheduler.register_task(self.at(phases.warmup) + 1, self.round_planes)
        scheduler.register_task(self.at(phases.scene), self.train_all_but_planes)
        scheduler.register_task(self.at(phases.planes), self.train_everything)

    def update_cam_mask(self, model: CatAnchors, cameras: CameraIterator, rasterizer: Rasterizer) -> None:
        """Count the views that see each anchor, where anchors came or went since the last time."""
        if model.views_stale:
            if self._cameras is None:  # moved once: moving to a GPU waits for it
                self._cameras = [view.camera.to(model.device) for view in cameras]
            model.count_views(self._cameras, rasterizer)

    def adjust_anchor(  # type: ignore[override]
        self, model: CatAnchors, optimizer: SplatOptimizer, step: int, log: TaskLog | None = None
    ) -> None:
        super().adjust_anchor(model, optimizer, step, log)
        model.views_stale = True  # also if as many came as went

    def setup_triplane(self, model: CatAnchors, optimizer: SplatOptimizer) -> None:
        """Lay the principal axes through the anchors of now, and make planes as fine as their number asks for."""
        settings, context = self.opt.context, model.context
        resolution = base_resolution(model.num_rows, settings.anchors_per_cell)
        context.fit_frame(model.positions(), neighbors=settings.neighbors, contamination=settings.contamination)
        for i, plane in enumerate(context.triplane.initial(resolution, self.plane_draws)):
            optimizer.replace(model, f"context.triplane.planes.{i}", plane)
        if settings.start == "statistics":
            context.start_at(model.raw(torch.nonzero(model.kept()).squeeze(1)))
        log.debug("triplane of base resolution %d for %d anchors", resolution, model.num_rows)

    def train_spatial_models(self, model: CatAnchors) -> None:
        """Train the spatial models alone for a while, or nothing as the authors' code does."""
        alone: Trained = "nothing" if self.opt.phases.official_warmup else "spatial models"
        model.train_only(alone)

    def round_planes(self, model: CatAnchors) -> None:
        """Use the planes as the file will have them from now on, and count their bits."""
        model.context.rounded = True

    def train_all_but_planes(self, model: CatAnchors) -> None:
        model.train_only("all but planes")

    def train_everything(self, model: CatAnchors) -> None:
        model.train_only("everything")

    # Loss

    def extra_loss(self, model: Any, result: RenderResult, step: int) -> dict[str, Weighted]:
        """Return the terms of masks, of the anchors' rate and of the planes' rate, each from its phase on."""
        rate = self.opt.rate_term
        weight = rate.weight * (1.0 if self.leading is None else self.leading.factor)
        terms: dict[str, Weighted] = {}
        if step >= self.at(self.opt.phases.quantize):
            masks = max(rate.mask_floor, rate.mask_factor * weight)
            terms["masks"] = masks, torch.sigmoid(model.mask_logits).mean()
        if "rate" in result.extras:
            terms["rate"] = weight, result.extras["rate"].bits
        if model.context.rounded:
            terms["triplane"] = weight * rate.triplane, self._plane_bits(model)
        return terms

    def _plane_bits(self, model: CatAnchors) -> Tensor:
        """Bits of the planes per number of all anchors."""
        numbers = model.num_rows * sum(model.context.shape.widths)
        return model.plane_bits(self.opt.rate_term.triplane_sample) / numbers

    def whole_step(self, state: Any, view: View, camera: Any, background: Tensor) -> Any:
        plain = type(self).loss is CatStage.loss and state.model.trained not in WITHOUT_PICTURES
        return self._whole.of(self, state, view, camera, background) if plain else None

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        assert isinstance(model, CatAnchors)
        if model.trained not in WITHOUT_PICTURES:
            return super().loss(model, view, result, background, step)
        # A leaf of its own, so that there is a derivative to take where nothing learns.
        total = result.image.new_zeros((), requires_grad=True)
        if not model.context.rounded or model.trained == "nothing":
            return LossPack(total, {})
        bits = self._plane_bits(model)
        return LossPack(total + bits, {"triplane": bits.detach()})


def base_resolution(anchors: int, anchors_per_cell: float) -> int:
    """Return the rows of the coarsest planes, one cell per `anchors_per_cell` anchors; at least 1."""
    return max(1, round(math.sqrt(anchors / anchors_per_cell)))
