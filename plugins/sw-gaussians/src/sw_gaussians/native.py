"""Native modules of this package: sparse Adam, prices of merging; on CUDA also gradient statistics and normals."""

from splatwizard_native import NativeModule

GAUSSIANS_CUDA = NativeModule(
    name="splatwizard_gaussians_cuda",
    package="sw_gaussians",
    face="kernels/cuda/face.h",
    sources=("kernels/cuda/face.cpp",),
    headers=("kernels/face.h", "kernels/cuda/*.h"),
    cuda_sources=("kernels/cuda/statistics.cu", "kernels/cuda/sparse_adam.cu", "kernels/cuda/disagreement.cu"),
    without="sparse Adam, gradient statistics and normal losses run on torch operations: the same numbers, slower",
)

GAUSSIANS = NativeModule(
    name="splatwizard_gaussians",
    package="sw_gaussians",
    face="kernels/face.h",
    sources=("kernels/face.cpp",),
    kernels=("kernels/sparse_adam.cpp", "kernels/merge_partners.cpp", "kernels/merge_pairs.cpp"),
    headers=("kernels/*.h",),
    cflags=("-fno-math-errno", "-fno-trapping-math"),  # without these GCC keeps sqrt and division out of vector code
    without="sparse Adam and merging run on torch operations: the same numbers, slower",
    cuda=GAUSSIANS_CUDA,
)
