// The statistics of one view in one launch: for some ten thousand Gaussians launches cost more than the work.
#include "kernels.h"

namespace splatwizard::cuda {
namespace {

constexpr int kThreads = 256;

__global__ void __launch_bounds__(kThreads) statistics_kernel(const Statistics s) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= s.count) return;
  const int32_t radius = s.radii[i];
  if (radius <= 0) return;
  const float2 d = reinterpret_cast<const float2*>(s.gradients)[i];
  s.grad_accum[i] += sqrtf(d.x * d.x + d.y * d.y);
  s.denom[i] += 1.f;
  s.max_radii[i] = fmaxf(s.max_radii[i], float(radius));
}

__global__ void __launch_bounds__(kThreads) fragment_statistics_kernel(const FragmentStatistics s) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i >= s.count) return;
  // In the order of the torch operations, so that the sums are theirs to the last bit; NaN stays NaN.
  const float opacity = 1.f / (1.f + expf(-s.logits[i]));
  const float clear = 1.f - opacity;
  const float2 view = reinterpret_cast<const float2*>(s.fragments)[i];
  float* sums = s.sums + 3 * i;
  sums[0] += s.gradients[i] / (clear < s.least_clear ? s.least_clear : clear);
  sums[1] += view.x;
  sums[2] += view.y;
}

}  // namespace

void fragment_statistics(const FragmentStatistics& args, cudaStream_t stream) {
  if (args.count > 0)
    fragment_statistics_kernel<<<unsigned((args.count + kThreads - 1) / kThreads), kThreads, 0, stream>>>(args);
}

void statistics(const Statistics& args, cudaStream_t stream) {
  if (args.count > 0)
    statistics_kernel<<<unsigned((args.count + kThreads - 1) / kThreads), kThreads, 0, stream>>>(args);
}

}  // namespace splatwizard::cuda
