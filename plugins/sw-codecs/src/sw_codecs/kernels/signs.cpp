// Lookup in a grid of signs, and its gradient by the signs, on the CPU.
#include "kernels.h"

namespace SW_ARCH {
namespace {

using namespace sw_grid;

template <int D>
void corners(const Signs& at, int64_t n, int level, int32_t* entries, float* weights) {
  float place[D];
  for (int axis = 0; axis < D; ++axis) place[axis] = at.x[n * at.columns + at.axis[axis]];
  corners_of<D, true>(at.levels.of[level], at.levels.mask, place, entries, weights);
}

// F: features, or 0 for any number of them.
template <int D, int F>
void lookup(const Signs& at, const float* table, float* found, const splatwizard::Parallel& parallel) {
  const int features = F > 0 ? F : at.features;
  parallel(at.count, 256, [&](int64_t begin, int64_t end) {
    int32_t entries[1 << D];
    float weights[1 << D], sums[F > 0 ? F : kMaxFeatures];
    for (int64_t n = begin; n < end; ++n)
      for (int level = 0; level < at.levels.count; ++level) {
        corners<D>(at, n, level, entries, weights);
        for (int k = 0; k < features; ++k) sums[k] = 0.f;
        for (int corner = 0; corner < 1 << D; ++corner) {
          const float* entry = table + int64_t(entries[corner]) * features;
          for (int k = 0; k < features; ++k) sums[k] += weights[corner] * sign_of(entry[k]);
        }
        float* to = found + n * at.row + level * features;
        for (int k = 0; k < features; ++k) to[k] = sums[k];
      }
  });
}

template <int D, int F>
void backward(const Signs& at, const float* gradient, float* table, const splatwizard::Parallel& parallel) {
  const int features = F > 0 ? F : at.features;
  parallel(at.levels.count, 1, [&](int64_t first, int64_t last) {
    int32_t entries[1 << D];
    float weights[1 << D];
    for (int64_t level = first; level < last; ++level)
      for (int64_t n = 0; n < at.count; ++n) {
        corners<D>(at, n, int(level), entries, weights);
        const float* from = gradient + n * at.row + level * features;
        for (int corner = 0; corner < 1 << D; ++corner) {
          float* entry = table + int64_t(entries[corner]) * features;
          for (int k = 0; k < features; ++k) entry[k] += weights[corner] * from[k];
        }
      }
  });
}

}  // namespace

void signs_lookup(const Signs& at, const float* table, float* found, const splatwizard::Parallel& parallel) {
  if (at.features == 4)
    at.axes == 2 ? lookup<2, 4>(at, table, found, parallel) : lookup<3, 4>(at, table, found, parallel);
  else
    at.axes == 2 ? lookup<2, 0>(at, table, found, parallel) : lookup<3, 0>(at, table, found, parallel);
}

void signs_backward(const Signs& at, const float* gradient, float* table, const splatwizard::Parallel& parallel) {
  if (at.features == 4)
    at.axes == 2 ? backward<2, 4>(at, gradient, table, parallel) : backward<3, 4>(at, gradient, table, parallel);
  else
    at.axes == 2 ? backward<2, 0>(at, gradient, table, parallel) : backward<3, 0>(at, gradient, table, parallel);
}

}  // namespace SW_ARCH
