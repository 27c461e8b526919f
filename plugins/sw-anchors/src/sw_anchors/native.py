"""Native modules of this package: spawning of Gaussians and rate terms, forward and backward, on CPU and CUDA."""

from __future__ import annotations

from splatwizard_native import NativeModule

ANCHORS_CUDA = NativeModule(
    name="sw_anchors_cuda",
    package="sw_anchors",
    face="kernels/cuda/face.h",
    sources=("kernels/cuda/face.cpp",),
    headers=(
        "kernels/calls.h",
        "kernels/face.h",
        "kernels/rows.h",
        "kernels/sample.h",
        "kernels/spawn.h",
        "kernels/cuda/*.h",
    ),
    cuda_sources=tuple(f"kernels/cuda/{name}.cu" for name in ("spawn", "rows", "networks", "statistics")),
    without="anchors are decoded by torch operations: the same numbers, slower",
)

ANCHORS = NativeModule(
    name="sw_anchors",
    package="sw_anchors",
    face="kernels/face.h",
    sources=("kernels/face_spawn.cpp", "kernels/face_rate.cpp"),
    kernels=(
        "kernels/spawn.cpp",
        "kernels/heads.cpp",
        "kernels/values.cpp",
        "kernels/steps.cpp",
        "kernels/bits.cpp",
    ),
    headers=("kernels/*.h",),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps sqrt and division out of vector code
    without="anchors are decoded by torch operations: the same numbers, slower",
    cuda=ANCHORS_CUDA,
)
