"""Axes of decoded splats by a compiled kernel, as `sw_wisp.shape` has them but for the last bits."""

from __future__ import annotations

from torch import Tensor

from sw_wisp.fast import exact_face
from sw_wisp.fast.exact_native import EXACT


def axes(six: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return log scales [N,3], ascending, and unit quaternions [N,4] of matrices [N,6] float64; None: no kernels."""
    if not (six.device.type == "cpu" and EXACT.try_load()):
        return None
    log_scales, quats = six.new_empty(len(six), 3), six.new_empty(len(six), 4)
    exact_face.axes(six=six.contiguous(), log_scales=log_scales, quats=quats)
    return log_scales, quats
