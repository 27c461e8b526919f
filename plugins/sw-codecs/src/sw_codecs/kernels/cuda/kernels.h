// The same on CUDA: plain pointers and a stream, no torch. Gradients are atomic sums.
#pragma once

#include <cuda_runtime_api.h>

#include "../grid.h"

namespace sw_grid::cuda {

void lookup(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* table, float* found,
            cudaStream_t stream);
void backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
              float* table, cudaStream_t stream);

// `four`: there are four features, and all addresses are multiples of 16 bytes.
void signs_lookup(const Signs& at, bool four, const float* table, float* found, cudaStream_t stream);
void signs_backward(const Signs& at, bool four, const float* gradient, float* table, cudaStream_t stream);

}  // namespace sw_grid::cuda
