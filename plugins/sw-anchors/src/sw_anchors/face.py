"""The operations of kernels/face.h on the CPU."""

from __future__ import annotations

from splatwizard_native import operations
from sw_anchors.native import ANCHORS as MODULE

__getattr__ = operations(MODULE, __name__)
