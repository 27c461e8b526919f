#include "face.h"

#include <splatwizard/cuda_face.h>

#include <limits>

#include "kernels.h"

using splatwizard::guarded_on_gpu;
using splatwizard::refuse;
namespace kernels = splatwizard::cuda;

namespace {

template <class Call>
kernels::Surface surface_of(const Call& call) {
  const int64_t most = std::numeric_limits<int32_t>::max();
  if (call.height > most || call.width > most || call.height < 0 || call.width < 0)
    refuse("maps of %lld x %lld", (long long)call.height, (long long)call.width);
  return {call.depth, call.normals, call.alpha, int32_t(call.width), int32_t(call.height),
          float(call.fx), float(call.fy), float(call.cx), float(call.cy)};
}

}  // namespace

SW_OPERATION(splatwizard_gaussians_cuda, sparse_adam) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    kernels::SparseAdamTensor tensors[kernels::kSparseAdamTensors];
    int held = 0;
    for (int64_t i = 0; i < call->count; ++i) {
      const sparse_update& u = call->updates[i];
      if (u.width < 0 || u.width >= 1 << 20) refuse("update %lld has rows of %lld numbers", (long long)i,
                                                    (long long)u.width);
      tensors[held++] = {u.param, u.grad, u.exp_avg, u.exp_avg_sq, u.width, float(u.lr), float(1. - u.beta1),
                         float(u.beta2), float(1. - u.beta2), float(u.eps)};
      if (held < kernels::kSparseAdamTensors && i + 1 < call->count) continue;
      kernels::sparse_adam(tensors, held, call->marked, call->rows, stream);
      held = 0;
    }
  });
}

SW_OPERATION(splatwizard_gaussians_cuda, view_statistics) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    kernels::statistics({call->gradients, call->radii, call->grad_accum, call->denom, call->max_radii, call->rows},
                        stream);
  });
}

SW_OPERATION(splatwizard_gaussians_cuda, fragment_statistics) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    kernels::fragment_statistics({call->gradients, call->logits, call->fragments, call->sums, float(call->least_clear),
                                  call->rows},
                                 stream);
  });
}

SW_OPERATION(splatwizard_gaussians_cuda, disagreement) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    kernels::disagreement(surface_of(*call), call->found, stream);
  });
}

SW_OPERATION(splatwizard_gaussians_cuda, disagreement_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    kernels::disagreement_backward(surface_of(*call), call->grad, call->to_depth, call->to_normals, stream);
  });
}
