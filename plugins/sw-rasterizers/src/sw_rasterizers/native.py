"""Native modules of the rasterizer kernels: sources and availability."""

from __future__ import annotations

from splatwizard_native import NativeModule

CFLAGS = ("-fno-math-errno", "-fno-trapping-math")
"""Neither changes a result: no caller reads errno, no one traps floating-point exceptions. Without them square roots
and selections stay scalar. Nothing of -ffast-math is needed, the packs are vectors as written."""

CXX17 = "-std=c++17"
"""Overrides the -std=c++20 of all modules: the same code, and the standard headers are read in half the time."""

MODULE_CUDA = NativeModule(
    name="sw_rasterizers_cuda",
    package="sw_rasterizers",
    sources=(
        "csrc/cuda/face_render.cpp",
        "csrc/cuda/face_backward.cpp",
        "csrc/cuda/face_scores.cpp",
        "csrc/cuda/face_shared.cpp",
    ),
    headers=("csrc/*.h", "csrc/cuda/*.h", "csrc/cpu/face.h", "csrc/cpu/simd.h"),
    cuda_sources=(
        "csrc/cuda/sort.cu",
        "csrc/cuda/blend_backward.cu",
        "csrc/cuda/blend.cu",
        "csrc/cuda/blend_few.cu",
        "csrc/cuda/flash.cu",
        "csrc/cuda/tcgs.cu",
        "csrc/cuda/fisher.cu",
        "csrc/cuda/project_backward.cu",
        "csrc/cuda/surfel_blend_backward.cu",
        "csrc/cuda/surfel_project_backward.cu",
        "csrc/cuda/surfel_blend.cu",
        "csrc/cuda/surfel_project.cu",
        "csrc/cuda/scores.cu",
        "csrc/cuda/project.cu",
        "csrc/cuda/emit.cu",
        "csrc/cuda/shade.cu",
        "csrc/cuda/shared_colors.cu",
    ),
    cflags=CFLAGS,
    without="rendering on a GPU falls back to the pure-torch reference, some hundred times slower",
    face="csrc/cuda/face.h",
)

MODULE = NativeModule(
    name="sw_rasterizers",
    package="sw_rasterizers",
    sources=("csrc/cpu/face.cpp", "csrc/cpu/face_scores.cpp", "csrc/cpu/face_shared.cpp"),
    kernels=(
        "csrc/cpu/blend_backward.cpp",
        "csrc/cpu/surfel_blend_backward.cpp",
        "csrc/cpu/surfel_blend.cpp",
        "csrc/cpu/surfel_project.cpp",
        "csrc/cpu/surfel_project_backward.cpp",
        "csrc/cpu/fisher.cpp",
        "csrc/cpu/scores.cpp",
        "csrc/cpu/project.cpp",
        "csrc/cpu/project_backward.cpp",
        "csrc/cpu/blend.cpp",
        "csrc/cpu/bin.cpp",
        "csrc/cpu/shared_colors.cpp",
    ),
    headers=("csrc/*.h", "csrc/cpu/*.h"),
    cflags=(CXX17, *CFLAGS),
    without="rendering falls back to the pure-torch reference, some hundred times slower",
    face="csrc/cpu/face.h",
    cuda=MODULE_CUDA,
)


def unavailable() -> str | None:
    """The reason why the compiled rasterizers cannot run on this CPU, or None; compiles nothing."""
    return MODULE.available()


def unavailable_on_cuda() -> str | None:
    """The reason why the compiled rasterizers cannot run on a GPU here, or None; compiles nothing."""
    return MODULE.available(cuda=True)
