"""The native module of what is coded in floating point or bits: grids, planes, Huffman codes, codebooks."""

from __future__ import annotations

from splatwizard_native import NativeModule

CODECS = NativeModule(
    name="sw_codecs",
    package="sw_codecs",
    sources=(
        "kernels/binding.cpp",
        "kernels/binding_sites.cpp",
        "kernels/binding_cuda.cpp",
        "kernels/binding_planes.cpp",
    ),
    kernels=(
        "kernels/grid.cpp",
        "kernels/signs.cpp",
        "kernels/sites.cpp",
        "kernels/huffman.cpp",
        "kernels/nearest.cpp",
    ),
    headers=("kernels/*.h", "kernels/cuda/*.h"),
    cuda_sources=(
        "kernels/cuda/grid.cu",
        "kernels/cuda/signs.cu",
        "kernels/cuda/plane_bits.cu",
        "kernels/cuda/triplane.cu",
    ),
    # A place is rounded as torch rounds it; no trap of a comparison keeps loops out of vector code.
    cflags=("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math"),
    without="hash grids and planes are looked up by torch operations, Huffman codes decoded by a loop, codebooks "
    "searched whole: slower",
)
