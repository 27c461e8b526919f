// The tiles that one splat is tried in, appended to the list of its chunk, and those of a chunk to those of all.
#pragma once

#include <algorithm>
#include <atomic>
#include <vector>

#include "../tiles.h"
#include "kernels.h"
#include "parallel.h"

namespace SW_ARCH {
using namespace sw;

struct TileList {
  std::vector<int32_t> tiles;
  size_t room = 0;     // further ones are counted, not kept
  int64_t listed = 0;  // with those
  size_t size() const { return tiles.size(); }
  void put(int tile) {
    if (tiles.size() < room) tiles.push_back(tile);
  }

  void start(int64_t room_left) {
    tiles.clear();
    room = room_left > 0 ? size_t(room_left) : 0, listed = 0;
  }
  // Moves what was listed of a chunk to that of all, whose number is `total`, if it still fits.
  template <class S>
  void keep(int64_t chunk, std::atomic<int64_t>& total, const Slots<S>& slots) const {
    const int64_t at = total.fetch_add(listed);
    slots.tile_at[chunk] = at;
    if (at + listed <= slots.room) std::copy(tiles.begin(), tiles.end(), slots.tiles + at);
  }
};

// Projects `count` Gaussians or surfels by project_chunk(chunk, tiles, &invalid), kChunk at a time. Writes how many are
// visible, not finite, and pairs with tiles to counts; returns the slots used.
template <class S, class ProjectChunk>
int64_t project_chunks(const splatwizard::Parallel* threads, int64_t count, const Slots<S>& slots, const int32_t* radii,
                       int64_t* counts, const ProjectChunk& project_chunk) {
  const int64_t chunks = (count + kChunk - 1) / kChunk;
  std::atomic<int64_t> next{0}, visible{0}, invalid{0}, listed{0};
  parallel(threads, [&] {
    TileList tiles;
    for (int64_t chunk; (chunk = next.fetch_add(1, std::memory_order_relaxed)) < chunks;) {
      int64_t bad = 0;
      tiles.start(slots.room - listed);
      project_chunk(chunk, tiles, &bad);
      tiles.keep(chunk, listed, slots);
      const int32_t* first = radii + chunk * kChunk;
      visible += std::count_if(first, first + std::min<int64_t>(kChunk, count - chunk * kChunk),
                               [](int32_t radius) { return radius > 0; });
      invalid += bad;
    }
  });
  counts[0] = visible, counts[1] = invalid, counts[2] = listed;
  int64_t used = 0;
  for (int64_t chunk = 0; chunk < chunks; ++chunk) used += slots.per_chunk[chunk];
  return used;
}

// From a record's ellipse, as far as accept(tile_x, tile_y) agrees, or from the square of `radius` around (u, v) that
// 3DGS takes. Returns how many.
template <class S, class Accept>
SW_HD int list_tiles(const View<S>& view, const Settings& settings, const S* record, S u, S v, S radius,
                     TileList& list, const Accept& accept) {
  const auto put = [&](int x, int y) { list.put(y * view.tiles_x() + x); };
  if (settings.tight) {
    const Ellipse<S> e{record[kU],
                       record[kV],
                       record[kHalfX],
                       record[kHalfY],
                       record[kWidth],
                       record[kLeanX],
                       record[kLeanY] * record[kHalfX]};
    int count = 0;
    tight_tiles(e, view.width, view.height, [&](int x, int y) {
      if (!accept(x, y)) return;
      put(x, y);
      ++count;
    });
    return count;
  }
  const TileRange square = classic_tiles(u, v, radius, view.tiles_x(), view.tiles_y());
  for (int y = square.y0; y < square.y1; ++y)
    for (int x = square.x0; x < square.x1; ++x) put(x, y);
  return square.count();
}

}  // namespace SW_ARCH
