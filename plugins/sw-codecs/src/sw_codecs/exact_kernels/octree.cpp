// Occupancies of an octree, level by level under range coding, and the nodes they stand for
// (sw_codecs.positions.octree).
#include "range_coded.h"

#include "ranges.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

constexpr int OCCUPANCIES = 255, CONTEXTS = 4;

// A table of counts as a model (docs/bitstream.md, tables of counts as models).
struct Model {
  uint32_t share[OCCUPANCIES + 1];
  uint8_t bucket[256];  // the entry of the smallest number with these leading eight bits
  int only = -1;        // the one entry that has a count, if there is no other

  explicit Model(const int64_t* counts) {
    double total = 0;
    int positive = 0;
    for (int i = 0; i < OCCUPANCIES; ++i) {
      total += static_cast<double>(counts[i]);
      if (counts[i] > 0) {
        only = i;
        ++positive;
      }
    }
    if (positive == 1) return;
    only = -1;
    const double factor = static_cast<double>(TOP - OCCUPANCIES) / total;
    double before = 0;
    for (int i = 0; i < OCCUPANCIES; ++i) {
      share[i] = static_cast<uint32_t>(before * factor) + static_cast<uint32_t>(i);
      before += static_cast<double>(counts[i]);
    }
    share[OCCUPANCIES] = TOP;
    for (int i = 0, entry = 0; i < 256; ++i) {
      while (share[entry + 1] <= static_cast<uint32_t>(i) << (BITS - 8)) ++entry;
      bucket[i] = static_cast<uint8_t>(entry);
    }
  }
};

}  // namespace

int32_t decode_octree(const OctreeArgs& a, int64_t* nodes, uint8_t* occupancy, int64_t* sizes) {
  Scratch<int64_t> other(a.points);
  Scratch<uint8_t> context(a.points), following(a.points);
  RangeReader coded(a.words, a.bytes);
  int64_t *now = a.depth % 2 ? other.data : nodes, *next = a.depth % 2 ? nodes : other.data, count = 1;
  now[0] = 0;
  context[0] = 0;
  for (int64_t level = 0; level < a.depth; ++level) {
    sizes[level] = count;
    for (int c = 0; c < CONTEXTS; ++c) {
      const Model model(a.counts + (level * CONTEXTS + c) * OCCUPANCIES);
      for (int64_t i = 0; i < count; ++i) {
        if (context[i] != c) continue;
        if (model.only >= 0) {
          occupancy[i] = static_cast<uint8_t>(model.only + 1);
          continue;
        }
        const uint64_t q = coded.quantile();
        if (q >= TOP) return WORDS_LEFT;
        int entry = model.bucket[q >> (BITS - 8)];
        while (model.share[entry + 1] <= q) ++entry;
        coded.take(model.share[entry], model.share[entry + 1]);
        occupancy[i] = static_cast<uint8_t>(entry + 1);
      }
    }
    int64_t children = 0;
    for (int64_t i = 0; i < count; ++i) children += __builtin_popcount(occupancy[i]);
    if (children > a.points) return BEYOND_LIMIT;
    int64_t at = 0;
    for (int64_t i = 0; i < count; ++i) {
      const int born = __builtin_popcount(occupancy[i]);
      for (unsigned left = occupancy[i]; left; left &= left - 1) {
        next[at] = now[i] << 3 | __builtin_ctz(left);
        following[at++] = static_cast<uint8_t>((born < CONTEXTS ? born : CONTEXTS) - 1);
      }
    }
    occupancy += count;
    count = children;
    int64_t* swap = now;
    now = next;
    next = swap;
    std::memcpy(context.data, following.data, static_cast<size_t>(count));
  }
  sizes[a.depth] = count;
  return FINE;
}

}  // namespace SW_ARCH
