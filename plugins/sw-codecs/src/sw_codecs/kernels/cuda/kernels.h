// The same on CUDA: plain pointers and a stream, no torch. Gradients are atomic sums, of floats in the order in which
// blocks come, or of whole numbers, the same in any order: those are zeros before, and `add_sums` adds them to floats.
#pragma once

#include <cuda_runtime_api.h>

#include "../grid.h"
#include "sums.h"

namespace sw_grid::cuda {

void lookup(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* table, float* found,
            cudaStream_t stream);
void backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
              float* table, cudaStream_t stream);
void backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
              const sw_sums::Sums& sums, cudaStream_t stream);
void add_sums(const sw_sums::Sums& sums, int64_t n, float* to, cudaStream_t stream);

// `four`: there are four features, and all addresses are multiples of 16 bytes.
void signs_lookup(const Signs& at, bool four, const float* table, float* found, cudaStream_t stream);
void signs_backward(const Signs& at, bool four, const float* gradient, float* table, cudaStream_t stream);
void signs_backward(const Signs& at, bool four, const float* gradient, const sw_sums::Sums& sums, cudaStream_t stream);

}  // namespace sw_grid::cuda
