// Triplanes on CUDA: plain pointers and a stream, no torch.
#pragma once

#include <cuda_runtime_api.h>

#include "../triplane.h"
#include "sums.h"

namespace sw_triplane::cuda {

// Tables of the scales.
struct Tables {
  float* of[kScales];
};

// The same as sums of whole numbers, each of at most `count` numbers, none beyond *largest.
struct SumTables {
  sw_sums::Whole* of[kScales];
  const float* largest;
  int64_t count;
};

// from [k][a][b] -> to [k][b][a]; with `gain` > 0 rounded to multiples of 1 / gain.
void transpose(const float* from, float* to, int k, int64_t a, int64_t b, float gain, cudaStream_t stream);
void transpose(const sw_sums::Sums& from, float* to, int k, int64_t a, int64_t b, cudaStream_t stream);

// Features [count][scales][3][channels]: of a scale the sum of its samples and those of all coarser ones. `four`: the
// channels are a multiple of four and all addresses of sixteen bytes.
void lookup(const Sites& sites, bool four, const Tables& tables, float* features, cudaStream_t stream);

// Adds the gradients by the tables; sums are atomic, of floats in the order in which blocks come. Sites that follow one
// another in the same cells share them.
void backward(const Sites& sites, bool four, const float* slopes, const Tables& tables, cudaStream_t stream);
void backward(const Sites& sites, bool four, const float* slopes, const SumTables& tables, cudaStream_t stream);

}  // namespace sw_triplane::cuda
