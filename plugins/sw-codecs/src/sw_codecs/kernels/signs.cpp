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

template <int D>
void lookup(const Signs& at, const float* table, float* found, const splatwizard::Parallel& parallel) {
  parallel(at.count, 256, [&](int64_t begin, int64_t end) {
    int32_t entries[1 << D];
    float weights[1 << D];
    for (int64_t n = begin; n < end; ++n)
      for (int level = 0; level < at.levels.count; ++level) {
        corners<D>(at, n, level, entries, weights);
        float* to = found + n * at.row + level * at.features;
        for (int k = 0; k < at.features; ++k) to[k] = 0.f;
        for (int corner = 0; corner < 1 << D; ++corner) {
          const float* entry = table + int64_t(entries[corner]) * at.features;
          for (int k = 0; k < at.features; ++k) to[k] += weights[corner] * sign_of(entry[k]);
        }
      }
  });
}

template <int D>
void backward(const Signs& at, const float* gradient, float* table, const splatwizard::Parallel& parallel) {
  parallel(at.levels.count, 1, [&](int64_t first, int64_t last) {
    int32_t entries[1 << D];
    float weights[1 << D];
    for (int64_t n = 0; n < at.count; ++n)
      for (int64_t level = first; level < last; ++level) {
        corners<D>(at, n, int(level), entries, weights);
        const float* from = gradient + n * at.row + level * at.features;
        for (int corner = 0; corner < 1 << D; ++corner)
          for (int k = 0; k < at.features; ++k)
            table[int64_t(entries[corner]) * at.features + k] += weights[corner] * from[k];
      }
  });
}

}  // namespace

void signs_lookup(const Signs& at, const float* table, float* found, const splatwizard::Parallel& parallel) {
  at.axes == 2 ? lookup<2>(at, table, found, parallel) : lookup<3>(at, table, found, parallel);
}

void signs_backward(const Signs& at, const float* gradient, float* table, const splatwizard::Parallel& parallel) {
  at.axes == 2 ? backward<2>(at, gradient, table, parallel) : backward<3>(at, gradient, table, parallel);
}

}  // namespace SW_ARCH
