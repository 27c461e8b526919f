"""The operations of kernels/cuda/face.h on a GPU."""

from __future__ import annotations

from splatwizard_native import operations
from sw_anchors.native import ANCHORS_CUDA as MODULE

__getattr__ = operations(MODULE, __name__)
