// Bits of a sample of anchors under predicted distributions on CUDA: plain pointers and a stream, no torch.
#pragma once

#include <cuda_runtime_api.h>

#include "../mixture.h"

namespace sw_hac::cuda {

// As kernels.h has them.
void mixture_bits(const Mixture& from, const MixtureSlopes& to, cudaStream_t stream);
void channel_inputs(const Channels& of, const float* x, const float* outputs, float* to, cudaStream_t stream);
void channel_slopes(const Channels& of, const ChannelSlopes& by, float* to_x, float* to_outputs, cudaStream_t stream);

}  // namespace sw_hac::cuda
