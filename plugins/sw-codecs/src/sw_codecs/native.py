"""The native modules of what is coded in floating point or bits: grids, planes, Huffman codes, codebooks."""

from __future__ import annotations

from splatwizard_native import NativeModule

# A place is rounded as torch rounds it; no trap of a comparison keeps loops out of vector code.
CFLAGS = ("-ffp-contract=off", "-fno-math-errno", "-fno-trapping-math")

CODECS_CUDA = NativeModule(
    name="sw_codecs_cuda",
    package="sw_codecs",
    face="kernels/cuda/face.h",
    sources=("kernels/cuda/face.cpp",),
    headers=(
        "kernels/calls.h",
        "kernels/face.h",
        "kernels/grid.h",
        "kernels/levels.h",
        "kernels/plane_bits.h",
        "kernels/triplane.h",
        "kernels/cuda/*.h",
    ),
    cuda_sources=(
        "kernels/cuda/grid.cu",
        "kernels/cuda/signs.cu",
        "kernels/cuda/plane_bits.cu",
        "kernels/cuda/triplane.cu",
    ),
    cflags=CFLAGS,
    without="hash grids and planes are looked up by torch operations: slower",
)

CODECS = NativeModule(
    name="sw_codecs",
    package="sw_codecs",
    face="kernels/face.h",
    sources=("kernels/face.cpp",),
    kernels=(
        "kernels/grid.cpp",
        "kernels/signs.cpp",
        "kernels/sites.cpp",
        "kernels/huffman.cpp",
        "kernels/nearest.cpp",
    ),
    headers=(
        "kernels/calls.h",
        "kernels/face.h",
        "kernels/grid.h",
        "kernels/kernels.h",
        "kernels/levels.h",
        "kernels/sites.h",
    ),
    cflags=CFLAGS,
    without="hash grids and planes are looked up by torch operations, Huffman codes decoded by a loop, codebooks "
    "searched whole: slower",
    cuda=CODECS_CUDA,
)
