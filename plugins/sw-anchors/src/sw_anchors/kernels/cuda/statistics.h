// Statistics of one view for growing and pruning anchors on CUDA: plain pointers and a stream, no torch.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

namespace sw_anchors::cuda {

// Of `seen` anchors with k offsets, each named once, and the `count` Gaussians that were drawn of them.
struct Seen {
  int64_t seen, k, count;
  const int64_t* rows;      // [seen]
  const float* opacities;   // [seen, k]
  const int64_t* drawn;     // [count] in 0 .. seen k - 1, each once
  const float* gradients;   // [count, 2]
  const int32_t* radii;     // [count]
};

// Of all anchors, and of their offsets.
struct Statistics {
  float *opacities, *views;        // [total] sums of those > 0; in how many views an anchor was seen
  float *gradients, *offset_views; // [total, k] sums of norms; in how many views an offset was drawn
};

// Adds those of one view; a Gaussian of radius 0 does not count.
void add_statistics(const Seen& from, const Statistics& to, cudaStream_t stream);

}  // namespace sw_anchors::cuda
