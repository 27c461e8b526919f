// Rows of anchors on CUDA: plain pointers and a stream, no torch.
#pragma once

#include <cuda_runtime_api.h>

#include "../rows.h"

namespace sw_anchors::cuda {

// Zeros in the first n rows of each `to`.
void clear(const RowCopies& copies, int64_t n, cudaStream_t stream);
// Row rows[i] of each `from` -> row i of `to`, for n rows.
void gather(const RowCopies& copies, const int64_t* rows, int64_t n, cudaStream_t stream);
// Row i of each `from` -> row rows[i] of `to`.
void scatter(const RowCopies& copies, const int64_t* rows, int64_t n, cudaStream_t stream);
// Row i of each `from`, float32, is added to row rows[i] of `to`; rows may be named more than once.
void add(const RowCopies& copies, const int64_t* rows, int64_t n, cudaStream_t stream);

// Values [C,F+6+3k]: features, exp of scales, offsets, each plus noise times the step of its group; masks [C,k] of 0 or
// 1; kept [C]: whether one of an anchor's masks is 1.
void values(const Rows& from, float* values, float* masks, float* kept, cudaStream_t stream);
// The gradients; that of a mask is the one of sigmoid(logit) times its weight.
void values_backward(const Rows& from, const RowSlopes& by, const RowGradients& to, cudaStream_t stream);

// Bits of bins a step wide under Gaussians, times whether an anchor counts, or for offsets their masks.
void sample_bits(const Sample& sample, const SampleBits& to, cudaStream_t stream);

}  // namespace sw_anchors::cuda
