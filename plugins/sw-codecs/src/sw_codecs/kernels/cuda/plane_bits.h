// Bits of planes on CUDA: plain pointers and a stream, no torch.
#pragma once

#include <cuda_runtime_api.h>

#include "../plane_bits.h"

namespace sw_planes::cuda {

// Rows of `partial` that `bits` fills for each orientation, on the current device; 0 where there are no values.
int parts_of(const Planes& planes);

// weights [orientations][kParameters] -> partial [orientations][parts_of(planes)][kSums], and planes.to where it is not
// null. Sums of `partial` are the same each time; those of planes.to are with planes.parts, else atomic.
void bits(const Planes& planes, const float* weights, float* partial, cudaStream_t stream);

}  // namespace sw_planes::cuda
