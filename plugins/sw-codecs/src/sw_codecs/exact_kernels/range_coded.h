// What is range coded: points as the occupancies of an octree (sw_codecs.positions.octree), and bits.
#pragma once
#include "kernels.h"

namespace splatwizard {

struct OctreeArgs {
  const uint8_t* words;
  int64_t bytes, depth, points;  // points: no level has more nodes
  const int64_t* counts;         // [depth, 4, 255] by level and by children of the parent; none empty
};

}  // namespace splatwizard

// Nodes go to nodes [points]; occupancies of all levels, one after another, to occupancy [depth * points]; numbers of
// nodes of each level, and of the nodes at the end, to sizes [depth + 1]. Bits go to bits [count]: `zeros` of 2^24 is the
// share of 0.
#define SW_DECLARE_RANGE_CODED(arch)                                                                               \
  namespace arch {                                                                                                 \
  int32_t decode_octree(const splatwizard::OctreeArgs&, int64_t* nodes, uint8_t* occupancy, int64_t* sizes);       \
  int32_t decode_bits(const uint8_t* words, int64_t bytes, uint32_t zeros, int64_t count, int32_t* bits);          \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_RANGE_CODED)
