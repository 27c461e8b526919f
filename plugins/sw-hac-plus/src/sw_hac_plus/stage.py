"""Training stage of HAC++: that of HAC with learning rates of its own, and the mean volume of masked Gaussians too."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sw_hac.stage import HACStage
from sw_hac_plus.config import HACPlusConfig

if TYPE_CHECKING:
    from collections.abc import Mapping

    from torch import Tensor

    from splatwizard_core.api import RenderResult

SMALLEST_RATE = 1e-7
"""Final learning rate of the masks where lambda is 0."""


class HACPlusStage(HACStage):
    """One stage of 30,000 steps in the phases of HACStage; `HACPlusRateModel` has the rate that prunes."""

    name = "hac-plus"
    opt: HACPlusConfig

    @property
    def masks_final(self) -> float:
        """Learning rate of the mask logits at `lr.max_steps`, times the scene extent."""
        lr = self.opt.lr
        by_rate = min(lr.masks_by_rate * self.opt.rate_term.weight, lr.masks_limit)
        return lr.masks_final if lr.masks_final is not None else max(by_rate, SMALLEST_RATE)

    def mask_rate(self, step: int) -> float:
        return self.decay(step, self.opt.lr.masks_init, self.masks_final)

    def learning_rates(self, step: int) -> Mapping[str, float]:
        lr, rates = self.opt.lr, super().learning_rates(step)
        if self.opt.channel.kind == "none":
            return rates
        return {**rates, "channel": self.decay(step, lr.channel_init, lr.channel_final)}

    def counted(self, result: RenderResult) -> Tensor:
        """Return how many Gaussians are drawn or masked, at least 1: masked ones count with a volume of 0."""
        return (result.extras["anchors"].opacities > 0).sum().clamp(min=1)
