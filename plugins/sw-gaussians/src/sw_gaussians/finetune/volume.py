"""Volume factor of pruning scores.

Source: LightGaussian (arXiv 2311.17245); MesonGS (arXiv 2409.09756).
"""

from __future__ import annotations

from typing import Literal

from torch import Tensor

VolumeNorm = Literal["unclamped", "paper_clamp"]


def volume_factor(log_scales: Tensor, v_pow: float, norm: VolumeNorm = "unclamped") -> Tensor:
    """Return (V / V_ref)^v_pow, [N], for log scales [N,3] and V the product of the three scales.

    v_pow   exponent; 0: the volume does not count
    norm    unclamped: V_ref is the volume that 90 % exceed, which changes no order; paper_clamp: the volume that 10 %
            exceed, and no ratio is above 1
    """
    log_volume = log_scales.sum(dim=1)
    n = len(log_volume)
    if n == 0:
        return log_volume
    descending = log_volume.sort(descending=True).values
    # Logarithms, since the volume of three tiny scales underflows.
    if norm == "paper_clamp":
        ratio = (log_volume - descending[min(int(0.1 * n), n - 1)]).clamp_max(0)
    else:
        ratio = log_volume - descending[int(0.9 * n)]
    return (v_pow * ratio).exp()
