"""The operations of kernels/face.h on the CPU."""

from splatwizard_native.face_operations import operations
from splatwizard_native.fused.native import TRAINING as MODULE

__getattr__ = operations(MODULE, __name__)
