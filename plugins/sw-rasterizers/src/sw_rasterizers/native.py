"""Native modules of the rasterizer kernels: sources and availability."""

from __future__ import annotations

from typing import Any

from splatwizard_native import NativeBuildError, NativeModule

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
    # Neither changes a result: no caller reads errno, no one traps floating-point exceptions. Without them square
    # roots and selections stay scalar. Nothing of -ffast-math is needed, the packs are vectors as written.
    cflags=("-fno-math-errno", "-fno-trapping-math"),
    without="rendering falls back to the pure-torch reference, some hundred times slower",
    face="csrc/cpu/face.h",
    cuda=NativeModule(
        name="sw_rasterizers_cuda",
        package="sw_rasterizers",
        sources=(
            "csrc/cuda/binding_cuda.cpp",
            "csrc/cuda/binding_draw_cuda.cpp",
            "csrc/cuda/binding_scores_cuda.cpp",
            "csrc/cuda/binding_surfel_cuda.cpp",
            "csrc/cuda/binding_shared_cuda.cpp",
        ),
        headers=("csrc/*.h", "csrc/cuda/*.h", "csrc/cpu/simd.h"),
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
        cflags=("-fno-math-errno", "-fno-trapping-math"),
        without="rendering on a GPU falls back to the pure-torch reference, some hundred times slower",
    ),
)


def cuda_ops() -> Any:
    """Return the ops on CUDA. Raises NativeBuildError."""
    import torch  # here: what a package offers is told without it

    if not MODULE.has_cuda():
        raise NativeBuildError(str(unavailable_on_cuda()))
    return torch.ops.sw_rasterizers


def unavailable() -> str | None:
    """The reason why the compiled rasterizers cannot run on this CPU, or None; compiles nothing."""
    return MODULE.available()


def unavailable_on_cuda() -> str | None:
    """The reason why the compiled rasterizers cannot run on a GPU here, or None; compiles nothing."""
    return MODULE.available(cuda=True)
