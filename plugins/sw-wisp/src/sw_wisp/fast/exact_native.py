"""Native module of decoding: running means of splats, ties, forecasts and axes, on all cores."""

from __future__ import annotations

from splatwizard_native import NativeModule

EXACT = NativeModule(
    name="sw_wisp_exact",
    package="sw_wisp",
    face="exact_kernels/ties_face.h",
    sources=(
        "exact_kernels/face.cpp",
        "exact_kernels/ties.cpp",
        "exact_kernels/forecasts.cpp",
        "exact_kernels/axes.cpp",
    ),
    kernels=("exact_kernels/pyramid.cpp",),
    headers=("exact_kernels/*.h",),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps floor out of vector code
    without="files of wisp are decoded by torch operations: the same integers, two to three times slower",
)
