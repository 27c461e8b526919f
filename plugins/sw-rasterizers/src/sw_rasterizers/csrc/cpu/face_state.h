// What the operations of face.h leave for each other, in memory of the caller's.
#pragma once

#include "surfel_kernels.h"
#include "../face_inputs.h"

namespace sw {

// Whether three colours in the record are all there is: the fast kernels.
inline bool is_plain(int64_t channels, int64_t colors, int64_t flags) {
  return channels == 3 && colors == 3 && !(flags & kMedianDepth);
}

// Of the projection: `splats`.
template <class S>
struct Splats {
  Slots<S> slots{};
  S* planes;  // of surfels
  Layout layout;

  // `sh_degree`: 0 where no slopes of colours are asked for.
  Splats(uint8_t* memory, int64_t count, int64_t channels, int64_t colors, int sh_degree, int64_t flags)
      : layout{memory} {
    if (count < 0) refuse("%lld Gaussians", (long long)count);
    const int64_t chunks = (count + kChunk - 1) / kChunk;
    slots.records = layout.take<S>(count * kRecord);
    slots.index = layout.take<int32_t>(count);
    slots.per_chunk = layout.take<int32_t>(chunks);
    slots.run = layout.take<PairRun>(count);
    slots.tile_at = layout.take<int64_t>(chunks);
    slots.clamped = layout.take<uint8_t>(count);
    slots.channels = layout.take<S>(is_plain(channels, colors, flags) ? 0 : count * channels);
    planes = layout.take<S>(flags & kSurfels ? count * kPlane : 0);
    const bool slopes = (flags & kSave) && !(flags & kForScores) && sh_degree > 0;
    slots.color_slope = layout.take<S>(slopes ? count * 9 : 0);
  }

  template <class Call>
  static Splats of(const Call& call, int64_t channels, int sh_degree) {
    const Splats found(call.splats, call.count, channels, call.color_channels, sh_degree, call.flags);
    found.layout.check("splats", call.splat_bytes);
    return found;
  }
};

// The lists of the tiles, and what is kept of their pixels: `lists`.
template <class S>
struct Lists {
  Pairs<S> pairs{};
  S* transmittance;
  int32_t *last, *median_pair;
  SurfelPixels<S> pixels{};
  Layout layout;

  Lists(uint8_t* memory, const View<S>& view, int64_t count, int64_t flags) : layout{memory} {
    if (count < 0 || count > std::numeric_limits<int32_t>::max()) refuse("%lld pairs", (long long)count);
    const bool save = flags & kSave;
    const int64_t tiles = tiles_of(view), of_pixels = save && (flags & kWithMaps) ? tiles * kTilePixels : 0;
    pairs.count = count;
    pairs.tile_start = layout.take<int64_t>(tiles + 1);
    pairs.slot = layout.take<int32_t>(count);
    pairs.origin = layout.take<int32_t>(save ? count : 0);
    pairs.blocks = layout.take<uint32_t>(save ? count : 0);
    transmittance = layout.take<S>(tiles * kTilePixels);
    last = layout.take<int32_t>(tiles * kTilePixels);
    median_pair = layout.take<int32_t>(save && (flags & kMedianDepth) ? int64_t(view.width) * view.height : 0);
    for (S** field : {&pixels.first, &pixels.sum, &pixels.square}) *field = layout.take<S>(of_pixels);
    pixels.median = layout.take<int32_t>(of_pixels);
  }

  template <class Call>
  static Lists of(const Call& call, const View<S>& view) {
    const Lists found(call.lists, view, call.pairs, call.flags);
    found.layout.check("lists", call.list_bytes);
    return found;
  }

  template <class Call>
  Canvas<S> canvas(const Call& call) const {
    Canvas<S> canvas{};
    canvas.channels = int(call.channels), canvas.color_channels = int(call.color_channels);
    canvas.background_is_image = call.backdrop != nullptr;
    canvas.background = numbers<S>(canvas.background_is_image ? call.backdrop : call.background);
    canvas.transmittance = transmittance, canvas.last = last, canvas.median_pair = median_pair;
    return canvas;
  }
};

// Sums of the backward pass: one row a pair, then those of shared shapes.
template <class S>
struct Sums {
  S *pairs, *shapes;
  Layout layout;
  Sums(uint8_t* memory, int64_t count, int columns, int64_t gaussians, int64_t shapes_shared) : layout{memory} {
    pairs = layout.take<S>(count * columns);
    shapes = layout.take<S>(shapes_shared > 0 ? shape_groups(gaussians, shapes_shared) * shapes_shared * kShapeSums : 0);
  }
};

}  // namespace sw
