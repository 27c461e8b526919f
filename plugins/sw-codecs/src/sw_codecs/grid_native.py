"""The native module of grids of learned numbers: their lookup and its gradient, on the CPU and on CUDA."""

from __future__ import annotations

from splatwizard_native import NativeModule

GRID = NativeModule(
    name="sw_codecs_grid",
    package="sw_codecs",
    sources=("grid_kernels/binding.cpp", "grid_kernels/binding_cuda.cpp"),
    kernels=("grid_kernels/lookup.cpp", "grid_kernels/signs.cpp"),
    headers=("grid_kernels/*.h", "grid_kernels/cuda/*.h"),
    cuda_sources=("grid_kernels/cuda/lookup.cu", "grid_kernels/cuda/signs.cu"),
    cflags=("-ffp-contract=off",),  # a place is rounded as torch rounds it
    seconds=10,
    without="hash grids are looked up by torch operations: the same numbers, slower",
)
