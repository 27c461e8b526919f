"""The operations of kernels/face.h on the CPU."""

from __future__ import annotations

from splatwizard_native import operations
from sw_gaussians.native import GAUSSIANS as MODULE

__getattr__ = operations(MODULE, __name__)
