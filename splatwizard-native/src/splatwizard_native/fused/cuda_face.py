"""The operations of kernels/cuda/face.h on a GPU."""

from splatwizard_native.face_operations import operations
from splatwizard_native.fused.native import TRAINING_CUDA as MODULE

__getattr__ = operations(MODULE, __name__)
