// Colours from codebooks on CUDA; what the arguments mean: cpu/shared_colors.h.
#pragma once

#include <cuda_runtime_api.h>

#include "../shared_colors.h"

namespace sw::cuda {

constexpr int kRunUsers = 128;    // users, in the order of their entries, that one warp adds up
constexpr int kEntryFloats = 48;  // of an entry at degree 3

void shade_shared(const SharedColors<float>& in, float* colors, cudaStream_t stream);
void shade_shared_backward(const SharedColors<float>& in, const float* gradient, float* passed, float* means, float* dc,
                           cudaStream_t stream);
// `codebook` holds zeros before; `carried` [ceil(N / kRunUsers)][kEntryFloats] is scratch.
void add_to_codebook(const SharedColors<float>& in, const int64_t* order, const int64_t* offsets, const float* passed,
                     float* codebook, float* carried, cudaStream_t stream);

}  // namespace sw::cuda
