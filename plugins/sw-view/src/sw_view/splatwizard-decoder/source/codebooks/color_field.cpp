#include "color_field.h"

#include <cmath>

namespace swz {

ColorField color_field;

namespace {

constexpr int64_t FINEST = 1 << 16;
constexpr uint64_t PRIMES[3] = {1, 2654435761, 805459861};

// Within distance 1 of the origin x / 4 + 1/2; beyond it distances r become 2 - 1 / r first.
void contract(const float* x, float* to) {
  const float length = __builtin_sqrtf(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]), r = length > 1 ? length : 1;
  for (int axis = 0; axis < 3; ++axis) to[axis] = x[axis] * ((2 - 1 / r) / r) / 4 + 0.5f;
}

}  // namespace

ColorField::ColorField(const Container& file) {
  levels = file.integer("grid_levels", 1, MOST_LEVELS);
  features = file.integer("grid_features", 1, 8);
  const auto coarsest = static_cast<double>(file.integer("grid_coarsest", 2, 1024));
  const Json* growth = file.value("grid_growth");
  if (growth == nullptr || !growth->is_number() || !(growth->number >= 1 && growth->number <= 4))
    refuse("header value 'grid_growth' must be a number in 1..4");
  log2_size = file.integer("grid_log2", 3, 24);
  hidden = file.integer("hidden", 1, 256);
  const double finest = coarsest * std::pow(growth->number, static_cast<double>(levels - 1));
  for (int64_t l = 0; l < levels; ++l) {
    const double share = static_cast<double>(l) / static_cast<double>(levels > 1 ? levels - 1 : 1);
    const double scale = coarsest * std::pow(finest / coarsest, share) - 1;
    const double vertices = __builtin_ceil(scale - 1e-9) + 1;
    if (vertices > FINEST)
      refuse("the finest level has ", grouped(static_cast<int64_t>(__builtin_ceil(finest - 1 - 1e-9) + 1)),
             " vertices an axis, at most ", grouped(FINEST), " can be");
    const auto resolution = static_cast<int64_t>(vertices), all = resolution * resolution * resolution;
    const int64_t most = int64_t{1} << log2_size, size = ((most < all ? most : all) + 7) / 8 * 8;
    level[l] = {scale, resolution, entries, size, all <= size};
    entries += size;
  }
}

void ColorField::look_up(const float* mean, const float* grid, float* to) const {
  float place[3];
  contract(mean, place);
  const uint64_t mask = (uint64_t{1} << log2_size) - 1;
  for (int64_t l = 0; l < levels; ++l, to += features) {
    const GridLevel& of = level[l];
    uint64_t ends[3][2];
    float weights[3][2];
    for (int axis = 0; axis < 3; ++axis) {
      const float at = place[axis] * static_cast<float>(of.scale) + 0.5f, cell = __builtin_floorf(at);
      weights[axis][1] = at - cell;
      weights[axis][0] = 1 - weights[axis][1];
      for (int end = 0; end < 2; ++end) {
        const int64_t last = of.resolution - 1, vertex = static_cast<int64_t>(cell) + end;
        ends[axis][end] = static_cast<uint64_t>(vertex < last ? vertex : last);
      }
    }
    for (int64_t k = 0; k < features; ++k) to[k] = 0;
    for (int corner = 0; corner < 8; ++corner) {
      uint64_t entry = 0, stride = 1;
      float weight = 1;
      for (int axis = 0; axis < 3; ++axis, stride *= static_cast<uint64_t>(of.resolution)) {
        const int end = corner >> axis & 1;
        weight *= weights[axis][end];
        if (of.dense) entry += ends[axis][end] * stride;
        else entry ^= ends[axis][end] * PRIMES[axis] & mask;
      }
      const float* values = grid + (of.first + static_cast<int64_t>(entry)) * features;
      for (int64_t k = 0; k < features; ++k) to[k] += weight * values[k];
    }
  }
}

}  // namespace swz
