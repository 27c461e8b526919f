#include "face.h"

#include <splatwizard/cuda_face.h>

#include <cmath>
#include <limits>

#include "kernels.h"

using splatwizard::guarded_on_gpu;
using splatwizard::refuse;
namespace kernels = splatwizard::cuda;

namespace {

kernels::Photometric photometric_of(const photometric_loss_call& call) {
  const int64_t lost = call.valid ? 10 : 0, most = std::numeric_limits<int>::max();
  if (call.planes < 1 || call.height <= lost || call.width <= lost)
    refuse("the image of %lld x %lld is too small", (long long)call.height, (long long)call.width);
  // Limits of a launch: planes and rows of tiles.
  if (call.planes > 65535 || call.height > 65535 * 32 || call.width > most / 2)
    refuse("%lld images of %lld x %lld are too large", (long long)call.planes, (long long)call.height,
           (long long)call.width);
  return {call.x, call.y, int(call.planes), int(call.height), int(call.width), call.valid, call.l1_weight,
          call.ssim_weight, call.offset, nullptr};
}

}  // namespace

SW_OPERATION(splatwizard_training_cuda, photometric_loss) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    kernels::Photometric args = photometric_of(*call);
    const int64_t sums = 2 + 2 * kernels::photometric_blocks(args);
    const int64_t slopes = call->grad ? 3 * call->planes * call->height * call->width : 0;
    if (call->scratch_count < sums + slopes)
      refuse("scratch has %lld numbers, not %lld", (long long)call->scratch_count, (long long)(sums + slopes));
    if (call->grad) args.slopes = call->scratch + sums;
    splatwizard::check(cudaMemsetAsync(call->scratch, 0, sizeof(float2), stream));
    auto* const places = reinterpret_cast<float2*>(call->scratch);
    float* const found = call->found;
    kernels::photometric(args, {reinterpret_cast<unsigned*>(places), places + 1}, {found, found + 1, found + 2}, stream);
    if (call->grad) kernels::photometric_backward(args, call->grad, stream);
  });
}

SW_OPERATION(splatwizard_training_cuda, adam) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    kernels::AdamTensor tensors[kernels::kAdamTensors];
    int held = 0;
    for (int64_t i = 0; i < call->count; ++i) {
      const adam_update& u = call->updates[i];
      if (u.step < 1 || u.count < 0) refuse("update %lld has step %lld of %lld numbers", (long long)i,
                                            (long long)u.step, (long long)u.count);
      const double t = double(u.step);
      tensors[held++] = {u.param, u.grad, u.exp_avg, u.exp_avg_sq, u.count, float(u.lr / (1. - std::pow(u.beta1, t))),
                         float(1. - u.beta1), float(u.beta2), float(1. - u.beta2),
                         float(1. / std::sqrt(1. - std::pow(u.beta2, t))), float(u.eps), 0};
      if (held < kernels::kAdamTensors && i + 1 < call->count) continue;
      kernels::adam(tensors, held, stream);
      held = 0;
    }
  });
}
