// Splats at the centres of cells of any level, as bits of an octree (docs/bitstream.md, `wisp`).
#include <algorithm>
#include <vector>

#include "range_coded.h"
#include "ranges.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

constexpr int64_t LOWEST = 3, HIGHEST = 18, CHILDREN = 60, ENDS = 180, MORE = 183, ON = 184, CONTEXTS = 185, MOST = 16;
constexpr int FIRST[4] = {0, 8, 26, 46};

// Where the nodes of a level lie, and which nodes share a face with each: [axis, far side], -1 for none.
struct Nodes {
  std::vector<int64_t> code;
  std::vector<int32_t> beside[6];
};

// The node of Morton code `code` beside that of `at` along an axis, at level 2; -1 behind the border.
int32_t at_level_two(int64_t at, int axis, int far) {
  const int64_t place = (at >> axis & 1) | (at >> (axis + 3) & 1) << 1, other = place + (far ? 1 : -1);
  if (other < 0 || other > 3) return -1;
  const int64_t rest = at & ~(int64_t{1} << axis | int64_t{1} << (axis + 3));
  return static_cast<int32_t>(rest | (other & 1) << axis | (other >> 1) << (axis + 3));
}

struct Level {
  const int32_t* zeros;  // of its contexts
  RangeReader& coded;
  bool damaged = false;

  bool bit(int64_t context) {
    const int one = coded.bit(static_cast<uint64_t>(zeros[context]));
    damaged |= one < 0;
    return one > 0;
  }
};

// Splats of earlier subsets in each child of the nodes: 0, 1 or 2 for more. Cells of the level ascend.
void known_children(const Nodes& nodes, const int64_t* cells, const int64_t* counts, int64_t known,
                    std::vector<uint8_t>& classes) {
  classes.assign(8 * nodes.code.size(), 0);
  for (int64_t i = 0, child = 0; i < known && child < static_cast<int64_t>(classes.size());) {
    const int64_t code = nodes.code[static_cast<size_t>(child >> 3)] << 3 | (child & 7);
    if (cells[i] == code) classes[static_cast<size_t>(child)] = counts[i] > 1 ? 2 : 1;
    cells[i] < code ? ++i : ++child;
  }
}

// Whether there is something in this child of some nodes.
[[gnu::noinline]] void fill_child(const Nodes& nodes, const uint8_t* classes, int64_t level, int child, int64_t begin,
                                  int64_t end, Level& bits, uint8_t* occupied) {
  const int far = __builtin_popcount(static_cast<unsigned>(child));
  const int32_t* beside[3];
  for (int axis = 0; axis < 3; ++axis) beside[axis] = nodes.beside[2 * axis + (child >> axis & 1)].data();
  for (int64_t i = begin; i < end; ++i) {
    const unsigned own = occupied[i];
    if (child == 7 && level > LOWEST && own == 0) {
      occupied[i] = 1 << 7;
      continue;
    }
    int known = 0, near = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const int sibling = child ^ 1 << axis;
      const int32_t at = beside[axis][i];
      if (child >> axis & 1)
        known += static_cast<int>(own >> sibling & 1) + (at < 0 ? 0 : occupied[at] >> sibling & 1);
      else
        near += at >= 0;
    }
    const int64_t context =
        CHILDREN * classes[8 * i + child] + FIRST[far] + 2 * (known * (4 - far) + near) + (own != 0);
    occupied[i] = static_cast<uint8_t>(own | static_cast<unsigned>(bits.bit(context)) << child);
  }
}

}  // namespace

int32_t decode_leaf_octree(const RangeSession& session, const LeafOctreeArgs& a, int64_t* levels, int64_t* codes) {
  RangeReader coded(session.words, session.bytes);
  session.load(coded);
  Nodes nodes;
  for (int64_t code = 0; code < (a.rows > 0 ? 64 : 0); ++code) {
    nodes.code.push_back(code);
    for (int side = 0; side < 6; ++side) nodes.beside[side].push_back(at_level_two(code, side >> 1, side & 1));
  }
  int64_t left = a.rows, found = 0, *key = codes;  // of a splat: low corner at level 18, then its level
  std::vector<uint8_t> occupied, classes, count;
  std::vector<int32_t> place;  // of each child among the nodes of the next level
  for (int64_t level = LOWEST; level <= HIGHEST && !nodes.code.empty(); ++level) {
    Level bits{a.zeros + (level - LOWEST) * CONTEXTS, coded};
    const auto size = static_cast<int64_t>(nodes.code.size());
    const int64_t* start = a.known_start + (level - LOWEST);
    known_children(nodes, a.known_cells + start[0], a.known_counts + start[0], start[1] - start[0], classes);
    occupied.assign(static_cast<size_t>(size), 0);
    for (int child = 0; child < 8; ++child) {
      constexpr int64_t SOME = 1 << 12;  // a call: WebAssembly takes better code for a function at its next call
      for (int64_t i = 0; i < size; i += SOME)
        fill_child(nodes, classes.data(), level, child, i, i + SOME < size ? i + SOME : size, bits, occupied.data());
      if (bits.damaged) return WORDS_LEFT;
    }
    std::vector<int64_t> children;  // 8 node + child
    for (int64_t i = 0; i < size; ++i)
      for (unsigned rest = occupied[static_cast<size_t>(i)]; rest; rest &= rest - 1)
        children.push_back(8 * i + __builtin_ctz(rest));
    const size_t many = children.size();
    count.assign(many, 1);
    if (level < HIGHEST)
      for (size_t i = 0; i < many; ++i) count[i] = bits.bit(ENDS + classes[static_cast<size_t>(children[i])]);
    for (int number = 1; number < MOST; ++number) {
      bool any = false;
      for (size_t i = 0; i < many; ++i)
        if (count[i] == number && bits.bit(MORE)) {
          ++count[i];
          any = true;
        }
      if (!any) break;
    }
    Nodes next;
    place.assign(static_cast<size_t>(8 * size), -1);
    for (size_t i = 0; i < many; ++i) {
      const int64_t child = children[i], code = nodes.code[static_cast<size_t>(child >> 3)] << 3 | (child & 7);
      left -= count[i];
      if (left < 0) return BEYOND_LIMIT;
      for (int n = 0; n < count[i]; ++n) key[found++] = code << 3 * (HIGHEST - level) << 5 | level;
      if (level == HIGHEST || (count[i] > 0 && !bits.bit(ON))) continue;
      place[static_cast<size_t>(child)] = static_cast<int32_t>(next.code.size());
      next.code.push_back(code);
    }
    if (bits.damaged) return WORDS_LEFT;
    if (left < static_cast<int64_t>(next.code.size())) return BEYOND_LIMIT;
    for (int side = 0; side < 6; ++side) {
      next.beside[side].reserve(next.code.size());
      for (const int64_t child : children) {
        if (place[static_cast<size_t>(child)] < 0) continue;
        const int axis = side >> 1;
        int64_t node = child >> 3;
        if ((child >> axis & 1) == (side & 1)) node = nodes.beside[side][static_cast<size_t>(node)];
        const int64_t other = 8 * node + ((child & 7) ^ 1 << axis);
        next.beside[side].push_back(node < 0 ? -1 : place[static_cast<size_t>(other)]);
      }
    }
    std::swap(nodes, next);
  }
  if (left > 0) return TOO_FEW;
  std::sort(key, key + found);
  for (int64_t i = 0; i < found; ++i) {
    levels[i] = key[i] & 31;
    codes[i] = key[i] >> 5 >> 3 * (HIGHEST - levels[i]);
  }
  session.store(coded);
  return FINE;
}

}  // namespace SW_ARCH
