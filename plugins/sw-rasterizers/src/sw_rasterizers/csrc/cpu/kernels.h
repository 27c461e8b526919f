// The CPU kernels: plain pointers and sizes. One .cpp a kernel; the memory is the caller's (face.h).
//
//   project            N Gaussians -> records of the drawn ones, in slots (chunk-wise compact, in index order)
//   bin                slots -> per tile a list of slots, front to back
//   blend              lists -> image
//   blend_backward     dL/dimage -> one row of sums per (splat, tile) pair
//   project_backward   rows -> gradients of the inputs
//
// S is float (vectorised) or double (for gradient checks, and for who needs it).
#pragma once

#include <cstdint>

#include <splatwizard/dispatch.h>

#include "../call.h"
#include "../camera.h"

namespace sw {

constexpr int kChunk = 1024;  // Gaussians a thread takes at a time; slots of a chunk start at its first index

// One drawn splat, 16 values: one cache line in float32.
// clang-format off
enum RecordField {
  kU, kV,                   // pixel position
  kA, kB, kC, kLevel,       // log2 alpha = A dx^2 + B dx dy + C dy^2 + level
  kRed, kGreen, kBlue,
  kDepth,                   // tz
  kLeanY, kLeanX,           // -Kb/Kc, -Kb/Ka: slopes of the ridges, for the box test
  kHalfX, kHalfY, kWidth,   // extents of the cut-off ellipse (tiles.h)
  kCutoff,                  // the ellipse is -(A dx^2 + B dx dy + C dy^2) <= cutoff
  kRecord
};
// clang-format on

// Sums of one (splat, tile) pair over the tile's pixels, v = dL/dsigma: sum v, v dx, v dy, v dx^2, v dx dy, v dy^2,
// then one sum of weight x gradient per channel; with absgrad two more at the end.
enum PairSum { kV0, kVx, kVy, kVxx, kVxy, kVyy, kMoments };

struct PairRun {  // the (splat, tile) pairs of a splat, one after the other; count 0: it turned out to draw nothing
  int32_t first, count;
};

template <class S>
struct Slots {
  S* records;          // [N][kRecord]
  int32_t* index;      // [N] Gaussian of the slot
  int32_t* per_chunk;  // [chunks] slots used
  PairRun* run;        // [N]; `first` counts within the chunk until bin_pairs
  int32_t* tiles;      // [room] the tiles of all pairs, chunk by chunk in any order; forward pass only
  int64_t room;
  int64_t* tile_at;    // [chunks] where those of the chunk begin
  S* color_slope;      // [N][9] d colour_c / d mean_j, or null
  uint8_t* clamped;    // [N] bit c: colour c was clamped at 0
  S* channels;         // [N][channels], or null if the three colours in the record are all
};

template <class S>
struct Pairs {
  int64_t count;
  int64_t* tile_start;  // [tiles + 1]
  int32_t* slot;        // [P] tile-major, front to back
  int32_t* origin;      // [P] number of the pair in splat-major order, or null
  uint32_t* blocks;     // [P] bit b: block b of the tile may be touched; filled by blend up to `last`, or null
};

template <class S>
struct Canvas {
  int channels, color_channels;
  S* image;             // [channels][H][W]
  const S* background;  // [colors] or [colors][H][W], or null
  bool background_is_image;
  S* alpha;              // [H][W], 1 - transmittance, or null
  S* transmittance;      // [tiles][kTilePixels], block by block
  int32_t* last;         // [tiles][kTilePixels] 1-based list position of the last blended splat
  S* median;             // [H][W] or null
  int32_t* median_pair;  // [H][W] pair origin of the median splat, -1 if none; or null
  int64_t* counters;     // [2] evaluated, blended pixel-splat pairs, or null: counting costs time
};

template <class S>
struct CanvasGradient {
  const S* image;   // [channels][H][W]
  const S* alpha;   // [H][W] or null
  const S* median;  // [H][W] or null
};

// Row length of the pair sums: moments, channels, absgrad (2), median (1). Plain RGB has a fixed row of 12 with room
// for absgrad, written and added up with full-width operations.
constexpr int kPlainColumns = 12;
inline int pair_columns(bool plain, int channels, bool absgrad, bool median) {
  return plain ? kPlainColumns : kMoments + channels + (absgrad ? 2 : 0) + (median ? 1 : 0);
}

}  // namespace sw

// The kernels, once per instruction set (splatwizard/dispatch.h).
//
// project_gaussians  returns the number of slots in use; counts [3]: Gaussians with a radius, those culled because a
//                    value is not finite, pairs of all that had tiles. More of these than there is room for: the lists
//                    have gaps, no other kernel may be called
// count_pairs        (splat, tile) pairs in all
// depth_order        slots in use, nearest first, equal depths in index order; `order` has room for all of them
// blend_backward     the last `detached` channels do not influence the geometry; sums [P][pair_columns]
#define SW_DECLARE_KERNELS(arch)                                                                                    \
  namespace arch {                                                                                                  \
  using namespace sw;                                                                                               \
  template <class S>                                                                                                \
  int64_t project_gaussians(const View<S>& view, const Gaussians<S>& g, const Settings& settings,                   \
                            const Channels& channels, const Slots<S>& slots, int32_t* radii, int64_t* counts);      \
  template <class S>                                                                                                \
  void visible_radii(const View<S>& view, const Gaussians<S>& g, const Settings& settings, int32_t* radii);         \
  template <class S>                                                                                                \
  int64_t count_pairs(int64_t count, const Slots<S>& slots);  \
  template <class S>                                                                                                \
  void depth_order(int64_t count, int64_t used, const Slots<S>& slots, const splatwizard::Parallel* threads,        \
                   int32_t* order);                                                                                 \
  template <class S>                                                                                                \
  void bin_pairs(const View<S>& view, const Settings& settings, int64_t count, int64_t used, const Slots<S>& slots, \
                 const int32_t* order, const Pairs<S>& pairs);                                                      \
  template <class S>                                                                                                \
  void blend(const View<S>& view, const Settings& settings, const Slots<S>& slots, const Pairs<S>& pairs,           \
             const Canvas<S>& canvas);                                                                              \
  template <class S>                                                                                                \
  void blend_backward(const View<S>& view, const Settings& settings, const Slots<S>& slots, const Pairs<S>& pairs,  \
                      const Canvas<S>& canvas, const CanvasGradient<S>& gradient, int detached, S* sums);           \
  template <class S>                                                                                                \
  void project_backward(const View<S>& view, const Gaussians<S>& g, const Settings& settings,                       \
                        const Channels& channels, const Slots<S>& slots, const S* sums, const Gradients<S>& out);   \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_KERNELS)
#undef SW_DECLARE_KERNELS
