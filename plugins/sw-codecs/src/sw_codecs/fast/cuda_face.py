"""Operations of kernels/cuda/face.h as it has them; kernel_operations.py makes room for what they write."""

from __future__ import annotations

from splatwizard_native import operations
from sw_codecs.native import CODECS_CUDA as MODULE

__getattr__ = operations(MODULE, __name__)
