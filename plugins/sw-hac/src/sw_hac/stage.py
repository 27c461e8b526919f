"""Training stage of HAC: that of anchor methods with a rate, in three phases, with the rate in the loss."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sw_anchors.coded_anchors import ENTROPY, QUANTIZED
from sw_anchors.phase_switch import PhaseSwitch
from sw_anchors.rate_model import AnchorRate
from sw_anchors.stage import CodedAnchorStage, Weighted

from sw_hac.config import HACParams
from sw_hac.model import HACAnchors

if TYPE_CHECKING:
    from collections.abc import Mapping

    from splatwizard_core.api import OptimizationParams, PipelineParams, RenderResult, Scheduler


class HACStage(CodedAnchorStage):
    """One stage of 30,000 steps in three phases: raw values; noise of fixed steps; noise of predicted steps and rate.

    Pictures, growth and learning rates of anchors: `sw_anchors.stage`.
    """

    name = "hac"
    opt: HACParams

    def learning_rates(self, step: int) -> Mapping[str, float]:
        lr = self.opt.lr
        return {
            **super().learning_rates(step),
            "grid": self.decay(step, lr.grid_init, lr.grid_final),
            "mlp_grid": self.decay(step, lr.mlp_grid_init, lr.mlp_grid_final),
        }

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_post_task(scheduler, ppl, opt)
        phases = self.opt.phases
        PhaseSwitch(self.at(phases.quantized), QUANTIZED).register(scheduler)
        scheduler.register_task(self.at(phases.rebound), self.update_anchor_bound)
        PhaseSwitch(self.at(phases.entropy), ENTROPY).register(scheduler)
        if self.opt.rate_term.start == "statistics":
            scheduler.register_task(self.at(phases.entropy), self.start_from_statistics)

    def start_from_statistics(self, model: HACAnchors) -> None:
        """Start the network behind the grid at mean and deviation of the values, see the model's method."""
        model.start_from_statistics()

    def extra_loss(self, model: HACAnchors, result: RenderResult, step: int) -> dict[str, Weighted]:
        """Return the terms of the rate, from the last phase on: bits per number of anchors and grid, and soft masks.

        rate    lambda times the bits per number over a sample of the visible anchors, times their kept share
        grid    lambda times the bits of all signs over the count of all numbers, N (F + 6 + 3k)
        masks   its weight times the mean of sigmoid(mask logit)

        Source: HAC (arXiv 2403.14530), section 4.
        """
        rate: AnchorRate | None = result.extras.get("rate")
        if rate is None:
            return {}
        assert rate.own_bits is not None
        factor: float = 1.0 if self.leading is None else self.leading.factor
        weight, masks = factor * self.opt.rate_term.weight, factor * self.opt.rate_term.masks
        terms = {
            "rate": (weight, rate.bits),
            "grid": (weight / max(model.num_rows * sum(model.shape.widths), 1), rate.own_bits),
        }
        return {**terms, "masks": (masks, model.soft_masks().mean())} if masks else terms
