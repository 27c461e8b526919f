// A hash grid of real numbers, and the corners of the cell around a place; the same for the CPU and for CUDA.
//
// Of a level, x in [0,1] is at x * scale + 0.5 cells; a corner is an entry of the level's table, dense (x first) or
// hashed, where vertices beyond the last one count as it. Every product is rounded before a sum, as torch does it, so
// that all agree on the cell (compiled with -ffp-contract=off).
#pragma once

#include <cstdint>

#if defined(__CUDACC__)
#define SW_GRID_HD __host__ __device__ __forceinline__
#else
#define SW_GRID_HD inline __attribute__((always_inline))
#endif

namespace sw_grid {

constexpr int kMaxLevels = 32, kMaxFeatures = 8;

struct Level {
  float scale;
  int32_t last;   // vertex of an axis
  int32_t start;  // first entry of its table
  int32_t dense;
};

struct Levels {
  Level of[kMaxLevels];
  int count;
  uint32_t mask;  // of a hashed table
};

// Places in a grid of signs, and where their features stand.
struct Signs {
  Levels levels;
  int64_t count;    // of places
  const float* x;   // [count, columns]
  int columns;
  int axes;         // of the grid: 2 or 3
  int axis[3];      // column of x for each
  int features;
  int64_t row;      // floats from a place's features to those of the next one
};

SW_GRID_HD float sign_of(float value) { return value >= 0.f ? 1.f : -1.f; }

SW_GRID_HD float rounded_product(float a, float b) {
#if defined(__CUDA_ARCH__)
  return __fmul_rn(a, b);  // never fused with the sum behind it
#else
  return a * b;
#endif
}

SW_GRID_HD uint32_t prime(int axis) { return axis == 0 ? 1u : axis == 1 ? 2654435761u : 805459861u; }

// Entries and weights of the 2^D corners, the first axis changing fastest. NaN counts as 0. In a grid of signs vertices
// on the border have no weight, the others are brought to sum 1, and outside the cube all weights are 0.
template <int D, bool kSigns = false>
SW_GRID_HD void corners_of(const Level& level, uint32_t mask, const float* x, int32_t* entries, float* weights) {
  uint32_t ends[D][2];
  float parts[D][2];
  uint32_t stride = 1;
  bool outside = false;
  for (int axis = 0; kSigns && axis < D; ++axis) outside = outside || !(x[axis] >= 0.f && x[axis] <= 1.f);
  for (int axis = 0; axis < D; ++axis) {
    const float inside = x[axis] > 0.f ? (x[axis] < 1.f ? x[axis] : 1.f) : 0.f;
    const float place = rounded_product(inside, level.scale) + 0.5f;
    const int32_t cell = int32_t(place);  // not negative: the floor
    parts[axis][1] = place - float(cell), parts[axis][0] = 1.f - parts[axis][1];
    if constexpr (kSigns) {
      if (outside || cell <= 0) parts[axis][0] = 0.f;
      if (outside || cell + 1 >= level.last) parts[axis][1] = 0.f;
      const float total = parts[axis][0] + parts[axis][1];
      if (total > 0.f) parts[axis][0] /= total, parts[axis][1] /= total;
    }
    for (int side = 0; side < 2; ++side) {
      const uint32_t vertex = uint32_t(cell + side < level.last ? cell + side : level.last);
      ends[axis][side] = level.dense ? vertex * stride : vertex * prime(axis);
    }
    stride *= uint32_t(level.last + 1);
  }
  for (int corner = 0; corner < 1 << D; ++corner) {
    uint32_t entry = ends[0][corner & 1];
    float weight = parts[0][corner & 1];
    for (int axis = 1; axis < D; ++axis) {
      const int side = corner >> axis & 1;
      entry = level.dense ? entry + ends[axis][side] : entry ^ ends[axis][side];
      weight *= parts[axis][side];
    }
    entries[corner] = level.start + int32_t(level.dense ? entry : entry & mask);
    weights[corner] = weight;
  }
}

}  // namespace sw_grid
