// Position codec `octree` (docs/bitstream.md, octree).
#pragma once
#include "base.h"

namespace swz {

struct Points {
  Buffer<int64_t> codes;  // Morton codes, ascending
  int64_t bits;

  // The coordinate of a point on an axis, 0 .. 2^21 - 1.
  int64_t coordinate(int64_t point, int axis) const {
    uint64_t v = static_cast<uint64_t>(codes[point]) >> axis & 0x1249249249249249;  // every third bit
    v = (v | v >> 2) & 0x10c30c30c30c30c3;
    v = (v | v >> 4) & 0x100f00f00f00f00f;
    v = (v | v >> 8) & 0x1f0000ff0000ff;
    v = (v | v >> 16) & 0x1f00000000ffff;
    v = (v | v >> 32) & 0x1fffff;
    return static_cast<int64_t>(v);
  }
};

constexpr int64_t MAX_POINTS = 1 << 26;

// Refuses more points than `most`, and than so few bytes may stand for.
Points octree(Bytes data, int64_t most = MAX_POINTS);

}  // namespace swz
