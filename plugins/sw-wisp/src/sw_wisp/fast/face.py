"""Operations of `kernels/face.h` on a CPU."""

from __future__ import annotations

from splatwizard_native import operations
from sw_wisp.fast.native import WISP as MODULE

__getattr__ = operations(MODULE, __name__)
