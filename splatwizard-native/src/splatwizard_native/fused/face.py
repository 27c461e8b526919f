"""The operations of kernels/face.h on the CPU."""

from __future__ import annotations

from splatwizard_native.fused.native import TRAINING as MODULE
from splatwizard_native.operations import operations

__getattr__ = operations(MODULE, __name__)
