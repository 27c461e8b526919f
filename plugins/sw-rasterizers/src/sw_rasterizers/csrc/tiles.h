// Which tiles a splat touches.
//
// Tight (SnugBox + AccuTile of Speedy-Splat, on pixel centres): the ellipse Ka dx^2 + 2 Kb dx dy + Kc dy^2 <= t is cut
// into slabs, one a tile row; the extreme x of each slab lies either at the ellipse's own rightmost / leftmost point or
// on one of the slab's two edges. A tile counts when the slab's x interval contains one of its pixel columns' centres.
// Classic: every tile of the square of the bounding radius, as 3DGS does.
#pragma once

#include "common.h"

namespace sw {

// The screen ellipse of one splat at its cut-off level, in the form in which slabs are cut from it.
template <class S>
struct Ellipse {
  S u, v;    // centre, pixels
  S hx, hy;  // half extents
  S wx;      // half width at the height of the centre, sqrt(t / Ka)
  S lean;    // x of the chord's middle per y: -Kb/Ka
  S tip;     // y of the rightmost point, relative to the centre: -(Kb/Kc) hx
};

struct TileRange {
  int x0, x1, y0, y1;  // half-open
  SW_HD int count() const { return x1 > x0 && y1 > y0 ? (x1 - x0) * (y1 - y0) : 0; }
};

template <class S>
SW_HD int to_int(S x, int low, int high) {  // clamps first: x may be anything but NaN
  return x <= S(low) ? low : (x >= S(high) ? high : int(x));
}

// Tiles of the square of radius r, in the original's integer-centre coordinates (p = u - 0.5).
template <class S>
SW_HD TileRange classic_tiles(S u, S v, S radius, int tiles_x, int tiles_y) {
  const S px = u - S(0.5), py = v - S(0.5), edge = S(1) / kTile;
  return {to_int((px - radius) * edge, 0, tiles_x), to_int((px + radius + (kTile - 1)) * edge, 0, tiles_x),
          to_int((py - radius) * edge, 0, tiles_y), to_int((py + radius + (kTile - 1)) * edge, 0, tiles_y)};
}

// First and last pixel whose centre lies in [center - reach_low, center + reach_high], clipped to [low, high];
// empty if first > last.
template <class S>
SW_HD void pixel_span(S low_edge, S high_edge, int low, int high, int* first, int* last) {
  *first = to_int(round_up(low_edge - S(0.5)), low, high + 1);
  *last = to_int(round_down(high_edge - S(0.5)), low - 1, high);
}

// The tiles of an ellipse's bounding box, and the pixels of it whose centres lie in the box; empty: no tile.
struct TileBox {
  TileRange tiles;
  int i0, i1, j0, j1;  // pixels, inclusive
};

template <class S>
SW_HD TileBox tile_box(const Ellipse<S>& e, int width, int height) {
  TileBox box;
  pixel_span(e.u - e.hx, e.u + e.hx, 0, width - 1, &box.i0, &box.i1);
  pixel_span(e.v - e.hy, e.v + e.hy, 0, height - 1, &box.j0, &box.j1);
  if (box.i0 > box.i1 || box.j0 > box.j1)
    box.tiles = {0, 0, 0, 0};
  else
    box.tiles = {box.i0 / kTile, box.i1 / kTile + 1, box.j0 / kTile, box.j1 / kTile + 1};
  return box;
}

// Tiles [first, last) of one row of tiles that the ellipse touches; `box` is its tile_box, `inverse_hy` 1 / e.hy.
template <class S>
SW_HD void slab_span(const Ellipse<S>& e, const TileBox& box, S inverse_hy, int row, int* first, int* last) {
  const int first_row = row * kTile > box.j0 ? row * kTile : box.j0;
  const int last_row = row * kTile + kTile - 1 < box.j1 ? row * kTile + kTile - 1 : box.j1;
  const S low = S(first_row) + S(0.5) - e.v, high = S(last_row) + S(0.5) - e.v;
  const S rl = low * inverse_hy, rh = high * inverse_hy;
  const S half_low = e.wx * square_root(maximum(S(0), S(1) - rl * rl));
  const S half_high = e.wx * square_root(maximum(S(0), S(1) - rh * rh));
  const S right = low <= e.tip && e.tip <= high ? e.hx : maximum(e.lean * low + half_low, e.lean * high + half_high);
  const S left =
      low <= -e.tip && -e.tip <= high ? -e.hx : minimum(e.lean * low - half_low, e.lean * high - half_high);
  int i0, i1;
  // Extents that overflow make the slab's ends NaN (infinity times 0): the comparisons then choose the ellipse's own.
  pixel_span(e.u + maximum(left, -e.hx), e.u + minimum(right, e.hx), box.i0, box.i1, &i0, &i1);
  *first = i0 / kTile;
  *last = i0 > i1 ? *first : i1 / kTile + 1;
}

// Calls visit(tile_x, tile_y) for each tile, rows top to bottom, left to right. Returns the number of calls.
template <class S, class Visit>
SW_HD int tight_tiles(const Ellipse<S>& e, int width, int height, Visit&& visit) {
  const TileBox box = tile_box(e, width, height);
  const TileRange& tiles = box.tiles;
  if (tiles.count() == 0) return 0;
  // A box in one tile that the image border does not cut: most splats of a trained scene.
  if (tiles.count() == 1 && e.u >= S(0) && e.v >= S(0) && e.u <= S(width) && e.v <= S(height)) {
    visit(tiles.x0, tiles.y0);
    return 1;
  }
  const S inverse_hy = S(1) / e.hy;
  int count = 0;
  for (int ty = tiles.y0; ty < tiles.y1; ++ty) {
    int first, last;
    slab_span(e, box, inverse_hy, ty, &first, &last);
    count += last - first;
    for (int tx = first; tx < last; ++tx) visit(tx, ty);
  }
  return count;
}

}  // namespace sw
