"""Native modules of this package: bits under predicted distributions, forward and backward, on CPU and CUDA."""

from __future__ import annotations

from splatwizard_native import NativeModule

HAC_CUDA = NativeModule(
    name="sw_hac_cuda",
    package="sw_hac",
    face="kernels/cuda/face.h",
    sources=("kernels/cuda/face.cpp",),
    headers=("kernels/face.h", "kernels/calls.h", "kernels/mixture.h", "kernels/cuda/*.h"),
    cuda_sources=("kernels/cuda/mixture.cu",),
    without="bits of anchors are counted by torch operations: the same numbers, slower",
)

HAC = NativeModule(
    name="sw_hac",
    package="sw_hac",
    face="kernels/face.h",
    sources=("kernels/face.cpp",),
    kernels=("kernels/mixture.cpp",),
    headers=("kernels/*.h",),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps sqrt and division out of vector code
    without="bits of anchors are counted by torch operations: the same numbers, slower",
    cuda=HAC_CUDA,
)
