#include "face.h"

#include <splatwizard/cuda_face.h>

#include "../calls.h"
#include "rows.h"

#define SW_WISP_OPERATION(operation)                                            \
  SW_OPERATION(sw_wisp_cuda, operation) {                                       \
    return splatwizard::guarded_on_gpu(call, [&](cudaStream_t stream) {         \
      sw_wisp::cuda::operation(sw_wisp::of_call(*call), stream);                \
    });                                                                         \
  }

SW_WISP_OPERATION(eight_bits)
SW_WISP_OPERATION(draw)
SW_WISP_OPERATION(draw_backward)
SW_WISP_OPERATION(bits)
SW_WISP_OPERATION(bits_backward)
SW_WISP_OPERATION(splats)
SW_WISP_OPERATION(splats_backward)
