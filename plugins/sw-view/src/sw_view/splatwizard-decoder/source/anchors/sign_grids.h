// Binary hash grids over space and its three planes, looked up in integers (docs/bitstream.md, binary hash grid).
#pragma once
#include "anchors.h"

namespace swz {

struct SignGrids {
  int64_t width = 0;  // outputs of all grids

  // Reads sizes from the header and signs from the section `grids`.
  explicit SignGrids(Container& file);
  // [rows, width] of codes [rows, 3], with 12 fractional bits.
  void features(const int64_t* codes, int64_t rows, int16_t* to) const;

 private:
  static constexpr int64_t MOST_LEVELS = 32;
  struct Grid {
    int axes[3], dimensions;
    int64_t levels = 0, dense = 0, entries = 0;
    int64_t last[MOST_LEVELS], start[MOST_LEVELS], column[MOST_LEVELS];  // dense levels first
    Buffer<uint16_t> signs;
  };
  Grid grids[4];
  int64_t features_of_entry, log2_size[2];

  void lay_out(Grid& grid, const IntegerList& resolutions, int64_t log2);
};

}  // namespace swz
