"""The native modules of the fused operations."""

from splatwizard_native.module import NativeModule

TRAINING_CUDA = NativeModule(
    name="splatwizard_training_cuda",
    package="splatwizard_native.fused",
    sources=("kernels/cuda/face.cpp",),
    headers=("kernels/face.h", "kernels/cuda/*.h"),
    cuda_sources=("kernels/cuda/ssim.cu", "kernels/cuda/adam.cu"),
    without="loss and optimizer run on torch operations: the same numbers, slower",
    face="kernels/cuda/face.h",
)

TRAINING = NativeModule(
    name="splatwizard_training",
    package="splatwizard_native.fused",
    sources=("kernels/face.cpp",),
    kernels=("kernels/ssim.cpp", "kernels/adam.cpp"),
    headers=("kernels/*.h",),
    # C++17: its standard headers are read in half the time. Without the other two GCC keeps sqrt and division out of
    # vector code. No -ffinite-math-only: a NaN in the image must reach the loss, where the trainer looks for it.
    cflags=("-std=c++17", "-fno-math-errno", "-fno-trapping-math"),
    without="loss and optimizer run on torch operations: the same numbers, the loss some six times slower",
    face="kernels/face.h",
    cuda=TRAINING_CUDA,
)
