// One dense Adam step, as torch.optim.Adam computes it:
//   m += (1 - b1)(g - m)     v = b2 v + (1 - b2) g^2     p -= lr/(1 - b1^t) m / (sqrt(v)/sqrt(1 - b2^t) + eps)
// 28 bytes of traffic for each parameter: the memory's speed is the limit. A block whose g, m and v are all zero
// would not change and is only read (12 bytes): the spherical-harmonics bands that are not yet trained.
#include <cmath>
#include <cstring>

#include "kernels.h"

namespace SW_ARCH {
namespace {

constexpr int64_t BLOCK = 512;

// Bit patterns, so that -0.0 and NaN count as not zero.
inline bool all_zero(const float* values, int64_t count) {
  uint32_t seen = 0;
  for (int64_t i = 0; i < count; ++i) {
    uint32_t bits;
    std::memcpy(&bits, values + i, sizeof bits);
    seen |= bits;
  }
  return seen == 0;
}

}  // namespace

void adam(const splatwizard::AdamArgs& args, const splatwizard::Parallel& parallel) {
  const float step_size = args.step_size, one_minus_beta1 = args.one_minus_beta1, beta2 = args.beta2,
              one_minus_beta2 = args.one_minus_beta2, inv_bias2 = args.inv_bias2, eps = args.eps;
  // 32 blocks, 64 kB an array: enough to pay for waking a thread.
  parallel((args.count + BLOCK - 1) / BLOCK, 32, [&](int64_t first, int64_t last) {
    for (int64_t block = first; block < last; ++block) {
      const int64_t begin = block * BLOCK;
      const int64_t count = args.count - begin < BLOCK ? args.count - begin : BLOCK;
      float* __restrict p = args.param + begin;
      const float* __restrict g = args.grad + begin;
      float* __restrict m = args.exp_avg + begin;
      float* __restrict v = args.exp_avg_sq + begin;
      if (eps > 0.f && all_zero(g, count) && all_zero(m, count) && all_zero(v, count)) continue;
#pragma omp simd
      for (int64_t i = 0; i < count; ++i) {
        const float gi = g[i];
        const float mi = m[i] + one_minus_beta1 * (gi - m[i]);
        const float vi = beta2 * v[i] + one_minus_beta2 * gi * gi;
        m[i] = mi;
        v[i] = vi;
        p[i] -= step_size * mi / (std::sqrt(vi) * inv_bias2 + eps);
      }
    }
  });
}

}  // namespace SW_ARCH
