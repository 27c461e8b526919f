// Lookup in a grid of real numbers, and its gradient, on the CPU.
#include "kernels.h"

namespace SW_ARCH {
namespace {

using namespace sw_grid;

// body(point, level, entries, weights) for a range of points and one of levels.
template <int D, class Body>
void for_cells(const Levels& levels, const float* x, int64_t begin, int64_t end, int first, int last,
               const Body& body) {
  int32_t entries[1 << D];
  float weights[1 << D];
  for (int64_t n = begin; n < end; ++n)
    for (int level = first; level < last; ++level) {
      corners_of<D>(levels.of[level], levels.mask, x + D * n, entries, weights);
      body(n, level, entries, weights);
    }
}

template <int D>
void lookup(const Levels& levels, int features, int64_t n, const float* x, const float* table, float* found,
            const splatwizard::Parallel& parallel) {
  parallel(n, 256, [&](int64_t begin, int64_t end) {
    for_cells<D>(levels, x, begin, end, 0, levels.count, [&](int64_t point, int level, const int32_t* entries,
                                                            const float* weights) {
      float* to = found + (point * levels.count + level) * features;
      for (int k = 0; k < features; ++k) {
        float sum = 0.f;
        for (int corner = 0; corner < 1 << D; ++corner)
          sum += weights[corner] * table[int64_t(entries[corner]) * features + k];
        to[k] = sum;
      }
    });
  });
}

template <int D>
void backward(const Levels& levels, int features, int64_t n, const float* x, const float* gradient, float* table,
              const splatwizard::Parallel& parallel) {
  parallel(levels.count, 1, [&](int64_t first, int64_t last) {
    for_cells<D>(levels, x, 0, n, int(first), int(last), [&](int64_t point, int level, const int32_t* entries,
                                                            const float* weights) {
      const float* from = gradient + (point * levels.count + level) * features;
      for (int corner = 0; corner < 1 << D; ++corner)
        for (int k = 0; k < features; ++k) table[int64_t(entries[corner]) * features + k] += weights[corner] * from[k];
    });
  });
}

}  // namespace

void grid_lookup(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* table,
                 float* found, const splatwizard::Parallel& parallel) {
  axes == 2 ? lookup<2>(levels, features, n, x, table, found, parallel)
            : lookup<3>(levels, features, n, x, table, found, parallel);
}

void grid_backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
                   float* table, const splatwizard::Parallel& parallel) {
  axes == 2 ? backward<2>(levels, features, n, x, gradient, table, parallel)
            : backward<3>(levels, features, n, x, gradient, table, parallel);
}

}  // namespace SW_ARCH
