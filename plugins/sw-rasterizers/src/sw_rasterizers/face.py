"""The operations of csrc/cpu/face.h on the CPU."""

from __future__ import annotations

from splatwizard_native import operations
from sw_rasterizers.native import MODULE

__getattr__ = operations(MODULE, __name__)
