"""Native module of this package: spawning of Gaussians, forward and backward, on CPU and CUDA."""

from __future__ import annotations

from splatwizard_native import NativeModule

ANCHORS = NativeModule(
    name="sw_anchors",
    package="sw_anchors",
    sources=(
        "kernels/binding.cpp",
        "kernels/binding_heads.cpp",
        "kernels/binding_values.cpp",
        "kernels/binding_steps.cpp",
        "kernels/binding_bits.cpp",
        "kernels/binding_mixture.cpp",
        "kernels/binding_cuda.cpp",
        "kernels/binding_rows.cpp",
        "kernels/binding_networks.cpp",
    ),
    kernels=(
        "kernels/spawn.cpp",
        "kernels/heads.cpp",
        "kernels/values.cpp",
        "kernels/steps.cpp",
        "kernels/bits.cpp",
        "kernels/mixture.cpp",
    ),
    headers=("kernels/*.h", "kernels/cuda/*.h"),
    cuda_sources=(
        "kernels/cuda/spawn.cu",
        "kernels/cuda/rows.cu",
        "kernels/cuda/networks.cu",
        "kernels/cuda/mixture.cu",
    ),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps sqrt and division out of vector code
    without="anchors are decoded by torch operations: the same numbers, slower",
)
