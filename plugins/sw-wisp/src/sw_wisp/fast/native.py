"""Native modules of this package's training: what a step does with the numbers of every splat, on CPU and CUDA."""

from __future__ import annotations

from splatwizard_native import NativeModule

WISP = NativeModule(
    name="sw_wisp",
    package="sw_wisp",
    face="kernels/face.h",
    sources=("kernels/face.cpp",),
    kernels=("kernels/rows.cpp",),
    headers=("kernels/*.h",),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps sqrt and division out of vector code
    without="wisp trains by torch operations: the same numbers, slower",
)
