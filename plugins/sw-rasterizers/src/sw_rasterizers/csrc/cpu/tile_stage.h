// What the forward and backward blend kernels share: a tile's geometry, and the staging of its splats.
//
// Splats of a tile are staged kStage at a time into small arrays, one array a field (L1-resident), and each gets a mask
// of the blocks (4x4 pixels, or 4x2 where no pack has 16 lanes) whose pixel centres its cut-off ellipse reaches: the
// exact minimum of the quadratic form over the box of centres, which lies on one of the two facing edges. So a pixel is
// tried with a splat only if its block is touched.
#pragma once

#include <algorithm>
#include <numeric>
#include <vector>

#include "../blend.h"
#include "kernels.h"

namespace SW_ARCH {
using namespace sw;

constexpr int kStage = 128;  // list positions in a stage fit a byte

// A block is one pack, or two of narrow ones: of small splats, the smaller it is the fewer pixels are tried in vain.
constexpr int kBlockWidth = 4, kBlockHeight = SW_LANES > 8 ? 4 : 2;  // pixels
constexpr int kBlocksPerRow = kTile / kBlockWidth, kBlockRows = kTile / kBlockHeight;
constexpr int kBlocks = kBlocksPerRow * kBlockRows;  // of a tile, at most the bits of Pairs::blocks
constexpr int kBlockPixels = kBlockWidth * kBlockHeight;

struct TileFrame {
  int x0, y0;         // first pixel
  int columns, rows;  // pixels inside the image
  template <class S>
  TileFrame(const View<S>& view, int64_t tile)
      : x0(int(tile % view.tiles_x()) * kTile),
        y0(int(tile / view.tiles_x()) * kTile),
        columns(std::min(kTile, view.width - x0)),
        rows(std::min(kTile, view.height - y0)) {}

  // Pixel of (block, index inside it), relative to the tile.
  static int pixel_x(int block, int i) { return block % kBlocksPerRow * kBlockWidth + i % kBlockWidth; }
  static int pixel_y(int block, int i) { return block / kBlocksPerRow * kBlockHeight + i / kBlockWidth; }

  template <class Visit>
  void for_each_pixel(const Visit& visit) const {  // visit(index in block order, x, y in the tile)
    for (int i = 0; i < kTilePixels; ++i) {
      const int x = pixel_x(i / kBlockPixels, i % kBlockPixels), y = pixel_y(i / kBlockPixels, i % kBlockPixels);
      if (x < columns && y < rows) visit(i, x, y);
    }
  }
};

// Centres of the tile's pixels, block by block.
template <class S, int kCount = kTilePixels>
struct PixelCentres {
  alignas(64) S x[kCount], y[kCount];
  void set(const TileFrame& frame) {
    for (int i = 0; i < kCount; ++i) {
      x[i] = S(frame.x0 + TileFrame::pixel_x(i / kBlockPixels, i % kBlockPixels)) + S(0.5);
      y[i] = S(frame.y0 + TileFrame::pixel_y(i / kBlockPixels, i % kBlockPixels)) + S(0.5);
    }
  }
};

template <class V>
struct TileStage {
  using S = Scalar<V>;
  using I = IntOf<V>;
  static constexpr int L = lanes_of<V>;
  alignas(64) S field[kRecord][kStage];
  alignas(64) int32_t blocks[kStage];

  // Stages list[0..count), of which `available` >= count entries may be read (and their records prefetched).
  void load_splats(const Slots<S>& slots, const int32_t* list, int count, int64_t available) {
    constexpr int kAhead = 2 * L < 16 ? 16 : 2 * L;
    const auto record = [&](int64_t k) { return slots.records + int64_t(list[k]) * kRecord; };
    for (int k = 0; k < count; k += L) {
      for (int i = 0; i < L; ++i)
        if (k + i + kAhead < available) __builtin_prefetch(record(k + i + kAhead));
      for (int f = 0; f < kRecord; f += L) {
        V rows[L];
        for (int i = 0; i < L; ++i) rows[i] = load<V>(record(k + i < count ? k + i : count - 1) + f);
        transpose(rows);
        for (int i = 0; i < L; ++i) store(field[f + i] + k, rows[i]);
      }
    }
  }

  // Block masks of the staged splats, a pack of splats at a time.
  void find_blocks(const TileFrame& frame, int count) {
    const auto c = [](double value) { return constant<V>(value); };
    for (int k = 0; k < count; k += L) {
      const auto at = [&](int f) { return load<V>(field[f] + k); };
      // The quadratic form grows with distance: a, c > 0.
      const V a = -at(kA), b = -at(kB), cc = -at(kC), cutoff = at(kCutoff);
      const V lean_x = at(kLeanX), lean_y = at(kLeanY), zero = c(0);
      const V width = c(kBlockWidth - 1), height = c(kBlockHeight - 1);  // between the outer centres
      const V left = c(frame.x0 + 0.5) - at(kU), top = c(frame.y0 + 0.5) - at(kV);
      V low_x[kBlocksPerRow], high_x[kBlocksPerRow], ridge_y[kBlocksPerRow];
      V square_x[kBlocksPerRow], slope_x[kBlocksPerRow];  // of the form on the vertical line nearest to the centre
      for (int i = 0; i < kBlocksPerRow; ++i) {
        low_x[i] = left + c(kBlockWidth * i);
        high_x[i] = low_x[i] + width;
        const V near_x = clamp(zero, low_x[i], high_x[i]);
        ridge_y[i] = lean_y * near_x;  // lowest point of the form on that line
        square_x[i] = a * near_x * near_x;
        slope_x[i] = b * near_x;
      }
      I mask = {};
      for (int j = 0; j < kBlockRows; ++j) {
        const V low_y = top + c(kBlockHeight * j), high_y = low_y + height;
        const V near_y = clamp(zero, low_y, high_y), ridge_x = lean_x * near_y;
        const V square_y = cc * near_y * near_y, slope_y = b * near_y;
        for (int i = 0; i < kBlocksPerRow; ++i) {
          const V y = clamp(ridge_y[i], low_y, high_y);
          const V x = clamp(ridge_x, low_x[i], high_x[i]);
          const V on_vertical = square_x[i] + (slope_x[i] + cc * y) * y;
          const V on_horizontal = square_y + (slope_y + a * x) * x;
          const I bit = I{} + int32_t(1u << (j * kBlocksPerRow + i));
          mask |= select(minimum(on_vertical, on_horizontal) <= cutoff, bit, I{});
        }
      }
      store(blocks + k, mask);
    }
  }
};

// Tiles with work, longest list first, for dynamic scheduling.
inline std::vector<int32_t> tiles_by_work(const int64_t* tile_start, int64_t tiles) {
  std::vector<int32_t> order(static_cast<size_t>(tiles));
  std::iota(order.begin(), order.end(), 0);
  std::stable_sort(order.begin(), order.end(), [&](int32_t a, int32_t b) {
    return tile_start[a + 1] - tile_start[a] > tile_start[b + 1] - tile_start[b];
  });
  return order;
}

}  // namespace SW_ARCH
