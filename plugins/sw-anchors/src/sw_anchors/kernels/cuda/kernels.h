// The same on CUDA: plain pointers and a stream, no torch.
#pragma once

#include <cuda_runtime_api.h>

#include "../spawn.h"

namespace sw_anchors::cuda {

void spawn(const Anchors& from, const Gaussians& to, cudaStream_t stream);
// ordered: sums of an anchor are those of the CPU; else atomic.
void spawn_backward(const Anchors& from, const Gaussians& slope, const Gradients& to, bool ordered,
                    cudaStream_t stream);

}  // namespace sw_anchors::cuda
