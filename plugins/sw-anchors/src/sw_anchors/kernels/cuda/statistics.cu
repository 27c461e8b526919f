// Statistics of one view: a thread an anchor, and a Gaussian. No two of them add to one number.
#include "statistics.h"

namespace sw_anchors::cuda {
namespace {

constexpr int kThreads = 128;

__global__ void __launch_bounds__(kThreads)
    statistics_kernel(const __grid_constant__ Seen from, const __grid_constant__ Statistics to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x, k = from.k;
  if (i < from.seen) {
    float sum = 0.f;
    for (int64_t j = 0; j < k; ++j) {
      const float opacity = from.opacities[i * k + j];
      sum += opacity < 0.f ? 0.f : opacity;
    }
    const int64_t anchor = from.rows[i];
    to.opacities[anchor] += sum, to.views[anchor] += 1.f;
  }
  if (i < from.count && from.radii[i] > 0) {
    const int64_t own = from.drawn[i], offset = from.rows[own / k] * k + own % k;
    const float x = from.gradients[2 * i], y = from.gradients[2 * i + 1];
    to.gradients[offset] += sqrtf(x * x + y * y), to.offset_views[offset] += 1.f;
  }
}

}  // namespace

void add_statistics(const Seen& from, const Statistics& to, cudaStream_t stream) {
  const int64_t threads = from.seen < from.count ? from.count : from.seen;
  if (threads > 0) statistics_kernel<<<unsigned((threads + kThreads - 1) / kThreads), kThreads, 0, stream>>>(from, to);
}

}  // namespace sw_anchors::cuda
