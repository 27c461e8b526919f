// The levels of a grid as callers tell them, checked; the same for the CPU and for CUDA.
#pragma once

#include <string>

#include "grid.h"

namespace sw_grid {

// Levels of a grid over `axes` axes; every entry they have is below `entries`. What does not fit goes to refuse(text),
// which does not return.
template <class Refuse>
Levels levels_of(int64_t count, const double* scales, const int64_t* lasts, const int64_t* starts, const int64_t* dense,
                 int64_t log2_size, int64_t axes, int64_t entries, const Refuse& refuse) {
  if (count < 1 || count > kMaxLevels || log2_size < 0 || log2_size > 30 || (axes != 2 && axes != 3))
    refuse("malformed levels");
  Levels levels{};
  levels.count = int(count), levels.mask = (uint32_t(1) << log2_size) - 1;
  for (int64_t i = 0; i < count; ++i) {
    const std::string level = "level " + std::to_string(i);
    if (lasts[i] < 1 || lasts[i] >= 1 << 16 || !(scales[i] > 0) || scales[i] > double(lasts[i] + 1) || starts[i] < 0)
      refuse(level + " is out of range");
    int64_t size = dense[i] ? 1 : int64_t(levels.mask) + 1;
    for (int64_t axis = 0; dense[i] && axis < axes; ++axis) size *= lasts[i] + 1;
    if (starts[i] > entries - size || entries >= int64_t(1) << 31)
      refuse(level + " ends at entry " + std::to_string(starts[i] + size) + " of " + std::to_string(entries));
    levels.of[i] = {float(scales[i]), int32_t(lasts[i]), int32_t(starts[i]), int32_t(dense[i] != 0)};
  }
  return levels;
}

}  // namespace sw_grid
