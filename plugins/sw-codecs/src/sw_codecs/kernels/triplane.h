// Lookup in triplanes at kept sites: what the CPU and CUDA share. Source: CAT-3DGS (arXiv 2503.00357).
#pragma once

#include <cstdint>

namespace sw_triplane {

constexpr int kPairs = 3, kCorners = 4, kScales = 4;

// Sites [count][scales][3][4]: rows of the tables around each place, and their weights. A table has a row of all
// channels for each value of the three planes of a scale.
struct Sites {
  int64_t count;
  int scales, channels;
  const int32_t* cells;
  const float* weights;
};

}  // namespace sw_triplane
