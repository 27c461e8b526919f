#include "face.h"

#include <splatwizard/cuda_face.h>

#include "../calls.h"
#include "mixture.h"

using namespace sw_hac;
using splatwizard::guarded_on_gpu;

SW_OPERATION(sw_hac_cuda, mixture_bits) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::mixture_bits(mixture_of(*call), slopes_of(*call), stream);
  });
}

SW_OPERATION(sw_hac_cuda, channel_inputs) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::channel_inputs(channels_of(*call, call->inputs), call->x, call->outputs, call->inputs, stream);
  });
}

SW_OPERATION(sw_hac_cuda, channel_slopes) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    cuda::channel_slopes(channels_of(*call, call->by_inputs),
                         {call->slope, call->by_x, call->by_outputs, call->by_inputs}, call->to_x, call->to_outputs,
                         stream);
  });
}
