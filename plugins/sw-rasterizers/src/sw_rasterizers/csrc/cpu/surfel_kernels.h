// The CPU kernels of surfels. Slots, binning, tiles and blocks are those of the other kernels: a record's ellipse is
// one that holds every pixel the surfel may touch (surfel.h), and the plane itself lies in a second row of the slot.
//
//   project_surfels           N surfels -> records and planes of the drawn ones
//   bin.cpp                   as for ellipsoids
//   blend_surfels             lists -> image and maps
//   blend_surfels_backward    gradients of both -> one row of sums per (splat, tile) pair
//   project_surfels_backward  rows -> gradients of the inputs
#pragma once

#include "../surfel.h"
#include "kernels.h"

namespace sw {

template <class S>
struct SurfelCanvas {
  Canvas<S> canvas;        // image, background, alpha, transmittance, last, counters
  S* maps;                 // [kMaps][H][W], or null
  SurfelPixels<S> pixels;  // null without maps, or if nothing is saved
};

// A surfel near the camera covers tiles and blocks that its ellipse cannot tell from those it misses (250k splats of
// benchmarks/rasterize_surfels.py: 314 of them caused three quarters of all evaluated pairs); its plane can.
template <class S>
struct LargeSurfel {
  static constexpr S kLargest = 24;  // pixels, half extents of the ellipse together
  const S* plane;
  S level, dot;
  bool is_large;
  SW_HD LargeSurfel(const S* record, const S* plane)
      : LargeSurfel(plane, record[kCutoff], record[kHalfX] + record[kHalfY]) {}
  SW_HD LargeSurfel(const S* plane, S cutoff, S extent)
      : plane(plane),
        level(S(2 * kLn2) * cutoff),
        dot(square_root(S(kSurfelDot) * level)),
        is_large(extent > kLargest) {}
  template <class V>
  SW_HD auto meets(V x, V y, S half) const {
    return surfel_meets_box<V>(plane, level, dot, x, y, half, half);
  }
};

}  // namespace sw

// planes [N][kPlane], by slot; `maps_gradient` [kMaps][H][W] or null.
#define SW_DECLARE_KERNELS(arch)                                                                                      \
  namespace arch {                                                                                                    \
  template <class S>                                                                                                  \
  int64_t project_surfels(const View<S>& view, const Gaussians<S>& g, const Settings& settings, const Slots<S>& slots, \
                          S* planes, int32_t* radii, int64_t* counts);                                                \
  template <class S>                                                                                                  \
  void visible_surfel_radii(const View<S>& view, const Gaussians<S>& g, const Settings& settings, int32_t* radii);    \
  template <class S>                                                                                                  \
  void blend_surfels(const View<S>& view, const Settings& settings, const Slots<S>& slots, const S* planes,           \
                     const Pairs<S>& pairs, const SurfelCanvas<S>& canvas);                                           \
  template <class S>                                                                                                  \
  void blend_surfels_backward(const View<S>& view, const Settings& settings, const Slots<S>& slots, const S* planes,  \
                              const Pairs<S>& pairs, const SurfelCanvas<S>& canvas, const CanvasGradient<S>& gradient, \
                              const S* maps_gradient, S* sums);                                                       \
  template <class S>                                                                                                  \
  void project_surfels_backward(const View<S>& view, const Gaussians<S>& g, const Settings& settings,                 \
                                const Slots<S>& slots, const S* sums, bool maps, const Gradients<S>& out);            \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_KERNELS)
#undef SW_DECLARE_KERNELS
