// The kernels on CUDA: plain pointers and a stream, no torch.
#pragma once
#include <cuda_runtime_api.h>

#include <cstdint>

namespace splatwizard::cuda {

// Adds one view to the statistics of adaptive density control; Gaussians with radius 0 are left alone.
struct Statistics {
  const float* gradients;  // [count, 2] NDC units, 8-byte aligned
  const int32_t* radii;    // [count] pixels
  float* grad_accum;       // [count] += length of the gradient
  float* denom;            // [count] += 1
  float* max_radii;        // [count] pixels
  int64_t count;
};

void statistics(const Statistics& args, cudaStream_t stream);

}  // namespace splatwizard::cuda
