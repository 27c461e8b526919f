// The cut-off ellipse of a splat and where it reaches: tiles when pairs are made, boxes of pixels inside a tile.
#pragma once

#include "../camera.h"
#include "../tiles.h"
#include "device.h"

namespace sw::cuda {

// The pixel test alone decides what is drawn; tiles and boxes are chosen on a slightly larger ellipse, so that its
// rounding never shows.
constexpr float kCutoffScale = 1.001f, kCutoffShift = 1e-3f;

// -(A dx^2 + B dx dy + C dy^2) at the edge of what is drawn.
__device__ __forceinline__ float cutoff_of(float level) {
  return (level - float(kLog2AlphaMin)) * kCutoffScale + kCutoffShift;
}

__device__ __forceinline__ Ellipse<float> ellipse_of(float u, float v, float a, float b, float c, float level,
                                                     float2 extent) {
  const float lean_x = -0.5f * b / a, lean_y = -0.5f * b / c;
  return {u, v, extent.x, extent.y, square_root(cutoff_of(level) / -a), lean_x, lean_y * extent.x};
}

// A thread lists up to kOwnRows tile rows of its splat alone; taller splats are walked by the whole warp, a row a lane.
constexpr int kOwnRows = 4;

__device__ __forceinline__ Ellipse<float> from_lane(const Ellipse<float>& e, int lane) {
  const auto from = [&](float x) { return __shfl_sync(kAllLanes, x, lane); };
  return {from(e.u), from(e.v), from(e.hx), from(e.hy), from(e.wx), from(e.lean), from(e.tip)};
}

// Tiles that an ellipse touches; by all lanes of a warp, `wanted` where there is one to count.
__device__ __forceinline__ int count_tiles(const View<float>& view, bool wanted, const Ellipse<float>& ellipse) {
  int tiles = 0, rows = 0;
  if (wanted) {
    const TileBox box = tile_box(ellipse, view.width, view.height);
    rows = box.tiles.y1 - box.tiles.y0;
    if (rows <= kOwnRows) tiles = tight_tiles(ellipse, view.width, view.height, [](int, int) {});
  }
  for (unsigned left = __ballot_sync(kAllLanes, rows > kOwnRows); left != 0; left &= left - 1) {
    const int owner = __ffs(int(left)) - 1;
    const Ellipse<float> e = from_lane(ellipse, owner);
    const TileBox box = tile_box(e, view.width, view.height);
    int count = 0;
    for (int row = box.tiles.y0 + lane_index(); row < box.tiles.y1; row += kWarp) {
      int first, last;
      slab_span(e, box, 1.f / e.hy, row, &first, &last);
      count += last - first;
    }
    count = int(warp_sum(unsigned(count)));
    if (lane_index() == owner) tiles = count;
  }
  return tiles;
}

// A tile is blended by boxes of 8 x 4 pixels, one a warp: box b covers column b % 2, row b / 2.
constexpr int kBoxWidth = 8, kBoxHeight = 4, kBoxColumns = kTile / kBoxWidth, kBoxRows = kTile / kBoxHeight;
constexpr int kBoxes = kBoxColumns * kBoxRows;

// Bit b: box b of the tile at (x0, y0) may hold a pixel that the splat reaches. Exact but for rounding: the minimum of
// the quadratic form over the box of pixel centres lies on one of the two edges that face the splat's centre.
__device__ __forceinline__ unsigned box_mask(float u, float v, float a, float b, float c, float level, int x0, int y0) {
  a = -a, b = -b, c = -c;
  const float cutoff = cutoff_of(level);
  const float lean_x = -0.5f * b / a, lean_y = -0.5f * b / c;
  const float left = float(x0) + 0.5f - u, top = float(y0) + 0.5f - v;
  float low_x[kBoxColumns], near_x[kBoxColumns], ridge_y[kBoxColumns];
#pragma unroll
  for (int i = 0; i < kBoxColumns; ++i) {
    low_x[i] = left + float(kBoxWidth * i);
    near_x[i] = fminf(fmaxf(0.f, low_x[i]), low_x[i] + (kBoxWidth - 1));
    ridge_y[i] = lean_y * near_x[i];
  }
  unsigned mask = 0;
#pragma unroll
  for (int j = 0; j < kBoxRows; ++j) {
    const float low_y = top + float(kBoxHeight * j), high_y = low_y + (kBoxHeight - 1);
    const float near_y = fminf(fmaxf(0.f, low_y), high_y), ridge_x = lean_x * near_y;
#pragma unroll
    for (int i = 0; i < kBoxColumns; ++i) {
      const float y = fminf(fmaxf(ridge_y[i], low_y), high_y);
      const float x = fminf(fmaxf(ridge_x, low_x[i]), low_x[i] + (kBoxWidth - 1));
      const float on_vertical = a * near_x[i] * near_x[i] + (b * near_x[i] + c * y) * y;
      const float on_horizontal = c * near_y * near_y + (b * near_y + a * x) * x;
      if (fminf(on_vertical, on_horizontal) <= cutoff) mask |= 1u << (j * kBoxColumns + i);
    }
  }
  return mask;
}

}  // namespace sw::cuda
