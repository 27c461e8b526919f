"""The native module of the exact mode: coding of symbols, networks and look-ups in integers, on all cores."""

from __future__ import annotations

from splatwizard_native import NativeBuildError, NativeModule

EXACT = NativeModule(
    name="sw_codecs_exact",
    package="sw_codecs",
    face="exact_kernels/face.h",
    sources=(
        "exact_kernels/face.cpp",
        "exact_kernels/face_mixtures.cpp",
        "exact_kernels/face_networks.cpp",
        "exact_kernels/face_planes.cpp",
        "exact_kernels/face_sessions.cpp",
    ),
    kernels=(
        "exact_kernels/lattice.cpp",
        "exact_kernels/network.cpp",
        "exact_kernels/planes.cpp",
        "exact_kernels/streams.cpp",
        "exact_kernels/lookups.cpp",
        "exact_kernels/mixtures.cpp",
        "exact_kernels/mixture_rows.cpp",
        "exact_kernels/octree.cpp",
        "exact_kernels/bits.cpp",
        "exact_kernels/sessions.cpp",
        "exact_kernels/leaf_octree.cpp",
    ),
    headers=("exact_kernels/*.h",),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps conversions out of vector code
    without="files of anchors decode by torch and the library constriction: the same bits, five to ten times slower",
)


def has_exact() -> bool:
    """Whether the kernels are built; loads them. For what any file has: compiling takes longer than it does without."""
    try:
        return EXACT.load_built()
    except NativeBuildError:
        return False
