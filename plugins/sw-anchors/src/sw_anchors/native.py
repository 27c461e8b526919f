"""Native module of this package: spawning of Gaussians and rate terms, forward and backward, on CPU and CUDA."""

from __future__ import annotations

from splatwizard_native import NativeModule

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
    cuda=NativeModule(
        name="sw_anchors_cuda",
        package="sw_anchors",
        sources=("kernels/binding_cuda.cpp", "kernels/binding_rows.cpp", "kernels/binding_networks.cpp"),
        headers=("kernels/binding.h", "kernels/rows.h", "kernels/sample.h", "kernels/spawn.h", "kernels/cuda/*.h"),
        cuda_sources=("kernels/cuda/spawn.cu", "kernels/cuda/rows.cu", "kernels/cuda/networks.cu"),
        without="anchors are decoded by torch operations: the same numbers, slower",
    ),
)
