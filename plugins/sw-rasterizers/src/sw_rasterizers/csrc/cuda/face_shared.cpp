// Colours from a codebook; the work is done in shared_colors.cu.
#include "face.h"

#include "../face_shared_inputs.h"
#include "face_state.h"
#include "shared_colors.h"

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

SW_OPERATION(sw_rasterizers_cuda, shade_shared) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    check_floats(*call);
    const auto shared = shared_of<float>(*call, nullptr);
    if (call->count > 0) cuda::shade_shared(shared, numbers<float>(call->colors), stream);
  });
}

SW_OPERATION(sw_rasterizers_cuda, shade_shared_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    check_floats(*call);
    const auto shared = shared_of<float>(*call, nullptr);
    float* const codebook = numbers<float>(call->of_codebook);
    float* const passed = numbers<float>(call->passed);
    check(cudaMemsetAsync(codebook, 0, size_t(call->entries * shared.stride) * sizeof(float), stream));
    if (call->count == 0) return;
    if (call->runs < (call->count + kRunUsers - 1) / kRunUsers) refuse("carried has %lld runs", (long long)call->runs);
    cuda::shade_shared_backward(shared, numbers<float>(call->by_colors), passed, numbers<float>(call->of_means),
                                numbers<float>(call->of_dc), stream);
    add_to_codebook(shared, call->order, call->offsets, passed, codebook, call->carried, stream);
  });
}
