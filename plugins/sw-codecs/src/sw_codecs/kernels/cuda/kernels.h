// The same on CUDA: plain pointers and a stream, no torch. Gradients are atomic sums.
#pragma once

#include <cuda_runtime_api.h>

#include "../grid.h"

namespace sw_grid::cuda {

constexpr int kMaxFeatures = 8;

void lookup(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* table, float* found,
            cudaStream_t stream);
void backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
              float* table, cudaStream_t stream);

}  // namespace sw_grid::cuda
