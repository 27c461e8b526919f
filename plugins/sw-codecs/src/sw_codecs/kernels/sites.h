// Features of places on planes of several scales, from the cells and weights of each place.
#pragma once

#include <cstdint>

namespace sw_sites {

constexpr int kMaxScales = 8, kPlanes = 3, kCorners = 4;

// Features of a scale are those of its three planes side by side; finer scales add to coarser ones.
struct Sites {
  int64_t count;           // of places
  int scales, channels;
  const int32_t* cells;    // [count, scales, 3, 4] rows of the scale's table
  const float* weights;    // [count, scales, 3, 4]
  int64_t rows[kMaxScales];
};

}  // namespace sw_sites
