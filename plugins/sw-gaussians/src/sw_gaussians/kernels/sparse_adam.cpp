// Adam of the rows that a mask marks; the others keep parameter and moments, and their gradient is not read:
//   m += (1 - b1)(g - m)     v = b2 v + (1 - b2) g^2     p -= lr m / (sqrt(v) + eps)
#include <cmath>

#include "kernels.h"

namespace SW_ARCH {
namespace {

void update(const splatwizard::SparseAdamArgs& args, int64_t begin, int64_t end) {
  const float one_minus_beta1 = args.one_minus_beta1, beta2 = args.beta2, one_minus_beta2 = args.one_minus_beta2,
              eps = args.eps, lr = args.lr;
  float* __restrict p = args.param;
  const float* __restrict g = args.grad;
  float* __restrict m = args.exp_avg;
  float* __restrict v = args.exp_avg_sq;
#pragma omp simd
  for (int64_t i = begin; i < end; ++i) {
    const float gi = g[i];
    const float mi = m[i] + one_minus_beta1 * (gi - m[i]);
    const float vi = beta2 * v[i] + one_minus_beta2 * gi * gi;
    m[i] = mi;
    v[i] = vi;
    p[i] -= lr * mi / (std::sqrt(vi) + eps);
  }
}

}  // namespace

void sparse_adam(const splatwizard::SparseAdamArgs& args, const splatwizard::Parallel& parallel) {
  const int64_t width = args.width;
  parallel(args.rows, 4096, [&](int64_t first, int64_t last) {
    // Neighbours that are both marked are one run: most parameters have too few columns to fill a vector.
    for (int64_t row = first; row < last;) {
      if (!args.mask[row]) {
        ++row;
        continue;
      }
      const int64_t begin = row;
      while (row < last && args.mask[row]) ++row;
      update(args, begin * width, row * width);
    }
  });
}

}  // namespace SW_ARCH
