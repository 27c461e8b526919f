// Lookup in a grid of signs, and its gradient by the signs, on the CPU.
//
// Corners are worked out for a pack of places at once, lane by lane with the operations of `corners_of`.
#include <algorithm>

#include "kernels.h"

namespace SW_ARCH {
namespace {

using namespace sw_grid;

constexpr int PACK = 16;

typedef float Four __attribute__((vector_size(16), aligned(4)));

template <int D>
struct Corners {
  alignas(64) int32_t entries[1 << D][PACK];
  alignas(64) float weights[1 << D][PACK];
};

// Coordinates of `count` places from the n-th on, axis by axis; the rest is 0.
template <int D>
void gather(const Signs& at, int64_t n, int count, float (*x)[PACK]) {
  for (int axis = 0; axis < D; ++axis)
    for (int p = 0; p < PACK; ++p) x[axis][p] = p < count ? at.x[(n + p) * at.columns + at.axis[axis]] : 0.f;
}

// As corners_of<D, true> of each place.
template <int D>
void corners(const Level& level, uint32_t mask, const float (*x)[PACK], Corners<D>& to) {
  alignas(64) float parts[D][2][PACK];
  alignas(64) uint32_t ends[D][2][PACK];
  alignas(64) int32_t outside[PACK] = {};
  for (int axis = 0; axis < D; ++axis)
    for (int p = 0; p < PACK; ++p) outside[p] |= !(x[axis][p] >= 0.f) | !(x[axis][p] <= 1.f);
  uint32_t stride = 1;
  for (int axis = 0; axis < D; ++axis) {
    const uint32_t factor = level.dense ? stride : prime(axis);
    for (int p = 0; p < PACK; ++p) {
      const float value = x[axis][p], above = value > 0.f ? value : 0.f, inside = above < 1.f ? above : 1.f;
      const float place = inside * level.scale + 0.5f;
      const int32_t cell = int32_t(place);  // not negative: the floor
      float far = place - float(cell), near = 1.f - far;
      near = outside[p] | (cell <= 0) ? 0.f : near;
      far = outside[p] | (cell + 1 >= level.last) ? 0.f : far;
      const float total = near + far, by = total > 0.f ? total : 1.f;
      parts[axis][0][p] = near / by, parts[axis][1][p] = far / by;
      ends[axis][0][p] = uint32_t(std::min(cell, level.last)) * factor;
      ends[axis][1][p] = uint32_t(std::min(cell + 1, level.last)) * factor;
    }
    stride *= uint32_t(level.last + 1);
  }
  for (int corner = 0; corner < 1 << D; ++corner)
    for (int p = 0; p < PACK; ++p) {
      uint32_t sum = ends[0][corner & 1][p], mixed = sum;
      float weight = parts[0][corner & 1][p];
      for (int axis = 1; axis < D; ++axis) {
        const int side = corner >> axis & 1;
        sum += ends[axis][side][p], mixed ^= ends[axis][side][p];
        weight *= parts[axis][side][p];
      }
      to.entries[corner][p] = level.start + int32_t(level.dense ? sum : mixed & mask);
      to.weights[corner][p] = weight;
    }
}

// F: 4 features, or 0 for any number of them.
template <int D, int F>
void lookup(const Signs& at, const float* table, float* found, const splatwizard::Parallel& parallel) {
  parallel((at.count + PACK - 1) / PACK, 16, [&](int64_t begin, int64_t end) {
    Corners<D> of;
    alignas(64) float x[D][PACK];
    for (int64_t n = begin * PACK; n < std::min(end * PACK, at.count); n += PACK) {
      const int count = int(std::min<int64_t>(PACK, at.count - n));
      gather<D>(at, n, count, x);
      for (int level = 0; level < at.levels.count; ++level) {
        corners<D>(at.levels.of[level], at.levels.mask, x, of);
        for (int p = 0; p < count; ++p) {
          float* to = found + (n + p) * at.row + level * at.features;
          if constexpr (F == 4) {
            Four sum = {};
            for (int corner = 0; corner < 1 << D; ++corner) {
              const float w = of.weights[corner][p];
              const Four entry = *reinterpret_cast<const Four*>(table + 4 * int64_t(of.entries[corner][p]));
              const Four weight = {w, w, w, w};
              sum += entry >= Four{} ? weight : -weight;
            }
            *reinterpret_cast<Four*>(to) = sum;
          } else {
            for (int k = 0; k < at.features; ++k) {
              float sum = 0.f;
              for (int corner = 0; corner < 1 << D; ++corner)
                sum += of.weights[corner][p] * sign_of(table[int64_t(of.entries[corner][p]) * at.features + k]);
              to[k] = sum;
            }
          }
        }
      }
    }
  });
}

template <int D, int F>
void backward(const Signs& at, const float* gradient, float* table, const splatwizard::Parallel& parallel) {
  parallel(at.levels.count, 1, [&](int64_t first, int64_t last) {
    Corners<D> of;
    alignas(64) float x[D][PACK];
    for (int64_t level = first; level < last; ++level)
      for (int64_t n = 0; n < at.count; n += PACK) {
        const int count = int(std::min<int64_t>(PACK, at.count - n));
        gather<D>(at, n, count, x);
        corners<D>(at.levels.of[level], at.levels.mask, x, of);
        for (int p = 0; p < count; ++p) {
          const float* from = gradient + (n + p) * at.row + level * at.features;
          for (int corner = 0; corner < 1 << D; ++corner) {
            const float w = of.weights[corner][p];
            float* entry = table + int64_t(of.entries[corner][p]) * at.features;
            if constexpr (F == 4)
              *reinterpret_cast<Four*>(entry) += Four{w, w, w, w} * *reinterpret_cast<const Four*>(from);
            else
              for (int k = 0; k < at.features; ++k) entry[k] += w * from[k];
          }
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
