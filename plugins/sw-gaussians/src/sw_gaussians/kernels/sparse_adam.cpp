// Adam of the rows that a mask marks; the others keep parameter and moments, and their gradient is not read:
//   m += (1 - b1)(g - m)     v = b2 v + (1 - b2) g^2     p -= lr/c1 m / (sqrt(v)/sqrt(c2) + eps)
// with c1 = c2 = 1, or c = 1 - b^t with the number of updates t that the row itself has had.
#include <cmath>

#include "kernels.h"

namespace SW_ARCH {
namespace {

struct Rates {
  float step_size, inv_bias2;
};

void update(const splatwizard::SparseAdamArgs& args, int64_t begin, int64_t end, Rates rates) {
  const float one_minus_beta1 = args.one_minus_beta1, beta2 = args.beta2, one_minus_beta2 = args.one_minus_beta2,
              eps = args.eps, step_size = rates.step_size, inv_bias2 = rates.inv_bias2;
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
    p[i] -= step_size * mi / (std::sqrt(vi) * inv_bias2 + eps);
  }
}

}  // namespace

void sparse_adam(const splatwizard::SparseAdamArgs& args, const splatwizard::Parallel& parallel) {
  const int64_t width = args.width;
  parallel(args.rows, 4096, [&](int64_t first, int64_t last) {
    if (args.row_steps == nullptr) {
      // Neighbours that are both marked are one run: most parameters have too few columns to fill a vector.
      for (int64_t row = first; row < last;) {
        if (!args.mask[row]) {
          ++row;
          continue;
        }
        const int64_t begin = row;
        while (row < last && args.mask[row]) ++row;
        update(args, begin * width, row * width, {static_cast<float>(args.lr), 1.f});
      }
      return;
    }
    for (int64_t row = first; row < last; ++row) {
      if (!args.mask[row]) continue;
      const double t = ++args.row_steps[row];
      const Rates rates{static_cast<float>(args.lr / -std::expm1(t * args.log_beta1)),
                        static_cast<float>(1. / std::sqrt(-std::expm1(t * args.log_beta2)))};
      update(args, row * width, (row + 1) * width, rates);
    }
  });
}

}  // namespace SW_ARCH
