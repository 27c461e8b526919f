// The calls of face.h on grids, which are offered on the CPU and on a GPU, as the kernels take them.
#pragma once
#include "face.h"
#include "levels.h"

namespace sw_grid {

template <class Call>
Levels levels_of(const Call* call, int64_t axes) {
  return levels_of(call->levels, call->scales, call->lasts, call->starts, call->dense, call->log2_size, axes,
                   call->entries, [](const std::string& text) { splatwizard::refuse("%s", text.c_str()); });
}

// `most` features of a level are offered.
template <class Call>
Levels features_of(const Call* call, int64_t most) {
  const Levels levels = levels_of(call, call->axes);
  if (call->features < 1 || call->features > most || call->width != call->levels * call->features)
    splatwizard::refuse("features do not fit");
  return levels;
}

// Places in a grid of signs; its features start at column `first`.
template <class Call>
Signs signs_of(const Call* call) {
  using splatwizard::refuse;
  if (call->features < 1 || call->features > kMaxFeatures || call->columns > 3)
    refuse("x must be [n,2 or 3], the table [entries,1 to %d]", kMaxFeatures);
  Signs at{};
  at.levels = levels_of(call, call->dimensions);
  at.count = call->count, at.columns = int(call->columns), at.axes = int(call->dimensions);
  for (int64_t i = 0; i < call->dimensions; ++i) {
    if (call->axes[i] < 0 || call->axes[i] >= call->columns) refuse("there is no axis %lld", (long long)call->axes[i]);
    at.axis[i] = int(call->axes[i]);
  }
  at.features = int(call->features), at.row = call->row, at.x = call->x;
  if (call->first < 0 || call->first > call->row - call->levels * call->features) refuse("features do not fit");
  return at;
}

}  // namespace sw_grid
