"""Native modules of this package's training: what a step does with the numbers of every splat, on CPU and CUDA."""

from __future__ import annotations

from splatwizard_native import NativeModule

WITHOUT = "wisp trains by torch operations: the same numbers, slower"

WISP_CUDA = NativeModule(
    name="sw_wisp_cuda",
    package="sw_wisp",
    face="kernels/cuda/face.h",
    sources=("kernels/cuda/face.cpp",),
    headers=("kernels/face.h", "kernels/calls.h", "kernels/kernels.h", "kernels/rows.h", "kernels/cuda/*.h"),
    cuda_sources=("kernels/cuda/rows.cu",),
    without=WITHOUT,
)

WISP = NativeModule(
    name="sw_wisp",
    package="sw_wisp",
    face="kernels/face.h",
    sources=("kernels/face.cpp",),
    kernels=("kernels/rows.cpp",),
    headers=("kernels/*.h",),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps sqrt and division out of vector code
    without=WITHOUT,
    cuda=WISP_CUDA,
)
