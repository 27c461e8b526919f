// exp of log scales and sigmoid of opacity logits in one launch, and their gradients in another: kernels so small that
// each of its own would cost the host more than the device.
#include "kernels.h"

namespace splatwizard::cuda {
namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) activate_kernel(const Activations a, float* scales, float* opacities) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, j = i - a.scales;
  if (i < a.scales)
    scales[i] = expf(a.of_scales[i]);
  else if (j < a.opacities)
    opacities[j] = 1.f / (1.f + expf(-a.of_opacities[j]));
}

__global__ void __launch_bounds__(kThreads)
    activate_backward_kernel(const Activations a, const float* scale_grads, const float* opacity_grads,
                             float* log_scale_grads, float* logit_grads) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, j = i - a.scales;
  if (i < a.scales) {
    log_scale_grads[i] = scale_grads[i] * a.of_scales[i];
  } else if (j < a.opacities) {
    const float opacity = a.of_opacities[j];
    logit_grads[j] = opacity_grads[j] * (1.f - opacity) * opacity;
  }
}

unsigned blocks(const Activations& a) { return unsigned((a.scales + a.opacities + kThreads - 1) / kThreads); }

}  // namespace

void activate(const Activations& a, float* scales, float* opacities, cudaStream_t stream) {
  if (blocks(a) > 0) activate_kernel<<<blocks(a), kThreads, 0, stream>>>(a, scales, opacities);
}

void activate_backward(const Activations& a, const float* scale_grads, const float* opacity_grads,
                       float* log_scale_grads, float* logit_grads, cudaStream_t stream) {
  if (blocks(a) > 0)
    activate_backward_kernel<<<blocks(a), kThreads, 0, stream>>>(a, scale_grads, opacity_grads, log_scale_grads,
                                                                 logit_grads);
}

}  // namespace splatwizard::cuda
