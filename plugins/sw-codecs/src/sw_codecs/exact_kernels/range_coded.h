// What is range coded: points as the occupancies of an octree (sw_codecs.positions.octree), bits, and
// symbols of several models from one stream.
#pragma once
#include "kernels.h"

namespace splatwizard {

struct OctreeArgs {
  const uint8_t* words;
  int64_t bytes, depth, points;  // points: no level has more nodes
  const int64_t* counts;         // [depth, 4, 255] by level and by children of the parent; none empty
};

// Words of a stream, and where its decoder stands: low, range, point, words read.
struct RangeSession {
  const uint8_t* words;
  int64_t bytes;
  int64_t* state;  // [4]

  template <class Reader>
  void load(Reader& coded) const {
    coded.low = static_cast<uint64_t>(state[0]);
    coded.range = static_cast<uint64_t>(state[1]);
    coded.point = static_cast<uint64_t>(state[2]);
    coded.at = state[3];
  }
  template <class Reader>
  void store(const Reader& coded) const {
    state[0] = static_cast<int64_t>(coded.low);
    state[1] = static_cast<int64_t>(coded.range);
    state[2] = static_cast<int64_t>(coded.point);
    state[3] = coded.at;
  }
};

struct LeafOctreeArgs {
  const int32_t* zeros;  // [16, 185]
  const int64_t *known_start, *known_cells, *known_counts;  // of each level ascending cells, and splats in them
  int64_t rows;
};

}  // namespace splatwizard

// Nodes go to nodes [points]; occupancies of all levels, one after another, to occupancy [depth * points]; numbers of
// nodes of each level, and of the nodes at the end, to sizes [depth + 1]. Bits go to bits [count]: `zeros` of 2^24 is the
// share of 0.
#define SW_DECLARE_RANGE_CODED(arch)                                                                               \
  namespace arch {                                                                                                 \
  int32_t decode_octree(const splatwizard::OctreeArgs&, int64_t* nodes, uint8_t* occupancy, int64_t* sizes);       \
  int32_t decode_bits(const uint8_t* words, int64_t bytes, uint32_t zeros, int64_t count, int32_t* bits);          \
  int32_t range_bits(const splatwizard::RangeSession&, const int32_t* zeros, int64_t count, bool* bits);            \
  int32_t range_entries(const splatwizard::RangeSession&, const splatwizard::Tables&, const int16_t* number,        \
                        int64_t count, int32_t* entries);                                                           \
  int32_t decode_leaf_octree(const splatwizard::RangeSession&, const splatwizard::LeafOctreeArgs&, int64_t* levels, \
                             int64_t* codes);                                                                       \
  int32_t range_choices(const splatwizard::RangeSession&, const double* counts, int64_t count, int32_t* entries);   \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_RANGE_CODED)
