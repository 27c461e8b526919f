// The colour field of `compact3dgs`: a hash grid over contracted space and a small network (docs/methods/compact3dgs.md).
#pragma once
#include "container.h"

namespace swz {

constexpr int64_t MOST_LEVELS = 32, DIRECTION_VALUES = 9;

struct GridLevel {
  double scale;
  int64_t resolution, first, entries;
  bool dense;
};

struct ColorField {
  GridLevel level[MOST_LEVELS];
  int64_t levels = 0, features = 0, log2_size = 0, hidden = 0, entries = 0;

  ColorField() = default;
  explicit ColorField(const Container& file);  // what the header describes
  int64_t width() const { return levels * features; }
  int64_t inputs() const { return width() + DIRECTION_VALUES + 1; }
  int64_t weights() const { return hidden * (inputs() + hidden + 3); }
  // What the grid [entries, features] has for a place [3]; float32, `width` numbers.
  void look_up(const float* mean, const float* grid, float* to) const;
};

extern ColorField color_field;  // of the file that was decoded; `hidden` is 0 if it has none

}  // namespace swz
