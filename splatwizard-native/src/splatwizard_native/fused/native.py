"""The native module of the fused operations."""

from __future__ import annotations

from splatwizard_native.module import NativeModule

TRAINING = NativeModule(
    name="splatwizard_training",
    package="splatwizard_native.fused",
    sources=("kernels/face.cpp",),
    kernels=("kernels/ssim.cpp", "kernels/adam.cpp"),
    headers=("kernels/*.h",),
    # Without these two GCC keeps sqrt and division out of vector code. No -ffinite-math-only: a NaN in the image
    # must reach the loss, where the trainer looks for it.
    cflags=("-fno-math-errno", "-fno-trapping-math"),
    without="loss and optimizer run on torch operations: the same numbers, the loss some six times slower",
    face="kernels/face.h",
    cuda=NativeModule(
        name="splatwizard_training_cuda",
        package="splatwizard_native.fused",
        sources=("kernels/binding_cuda.cpp",),
        headers=("kernels/adam_lists.h", "kernels/cuda/*.h"),
        cuda_sources=("kernels/cuda/ssim.cu", "kernels/cuda/adam.cu", "kernels/cuda/activations.cu"),
        without="activations, loss and optimizer run on torch operations: the same numbers, slower",
    ),
)
