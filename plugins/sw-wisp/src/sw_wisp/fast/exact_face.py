"""Operations of `exact_kernels/ties_face.h`."""

from __future__ import annotations

from splatwizard_native import operations
from sw_wisp.fast.exact_native import EXACT as MODULE

__getattr__ = operations(MODULE, __name__)
