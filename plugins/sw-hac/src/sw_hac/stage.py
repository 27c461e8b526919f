"""How HAC trains: the stage of all anchor methods, with noise, then a rate."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sw_anchors.coded_anchors import ENTROPY, QUANTIZED, AnchorRate
from sw_anchors.stage import AnchorStage

from splatwizard_core.api import PhaseSwitch
from sw_hac.config import HACConfig
from sw_hac.model import HACAnchors

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from splatwizard_core.api import OptimizationParams, PipelineParams, RenderResult, Scheduler


class HACStage(AnchorStage):
    """Three phases: raw values, noise of fixed steps, noise of predicted steps with the bits in the loss."""

    name = "hac"

    def __init__(self, opt: HACConfig) -> None:
        super().__init__(opt)
        self.hac = opt

    def learning_rates(self, step: int) -> Mapping[str, float]:
        lr = self.hac.lr
        return {
            **super().learning_rates(step),
            "grid": self.decay(step, lr.grid_init, lr.grid_final),
            "mlp_grid": self.decay(step, lr.mlp_grid_init, lr.mlp_grid_final),
        }

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        super().register_post_task(scheduler, ppl, opt)
        phases = self.hac.phases
        PhaseSwitch(self._at(phases.quantized), QUANTIZED).register(scheduler)
        scheduler.register_task(self._at(phases.rebound), self.update_anchor_bound)
        PhaseSwitch(self._at(phases.entropy), ENTROPY).register(scheduler)
        if self.hac.rate_term.start == "statistics":
            scheduler.register_task(self._at(phases.entropy), self.start_from_statistics)

    def _at(self, step: int) -> int:
        when = self.when(step)
        assert isinstance(when, int)
        return when

    def start_from_statistics(self, model: HACAnchors) -> None:
        model.start_from_statistics()

    def extra_loss(self, model: Any, result: RenderResult, step: int) -> dict[str, Tensor]:
        rate: AnchorRate | None = result.extras.get("rate")
        if rate is None:
            return {}
        assert rate.own_bits is not None
        weights, width = self.hac.rate_term, model.features.shape[1] + 6 + 3 * model.num_offsets
        return {
            "rate": weights.weight * rate.bits,
            "grid": weights.weight * rate.own_bits / (model.num_rows * width),
            "masks": weights.masks * model.soft_masks().mean(),
        }
