// The calls of face.h that are offered on the CPU and on a GPU, as the kernels take them.
#pragma once
#include "face.h"
#include "sample.h"
#include "spawn.h"

namespace sw_anchors {

// What all calls have; the rest is set by those who have it.
template <class Call>
Anchors anchors_of(const Call& call) {
  if (call.n < 0 || call.k < 1)
    splatwizard::refuse("%lld anchors with %lld offsets", (long long)call.n, (long long)call.k);
  Anchors from{};
  from.n = call.n, from.k = call.k, from.positions = call.positions, from.masks = call.masks;
  return from;
}

template <class Call>
void set_rows(const Call& call, Anchors& from) {
  from.offsets = call.offsets, from.offset_row = call.offset_row;
  from.scales = call.scales, from.scale_row = call.scale_row;
  from.alpha = call.alpha, from.drawn = call.drawn, from.count = call.count;
}

// Of spawn and spawn_backward.
template <class Call>
Anchors outputs_of(const Call& call) {
  Anchors from = anchors_of(call);
  set_rows(call, from);
  from.geometry = call.geometry, from.color = call.color;
  return from;
}

inline Gaussians spawned_of(const spawn_call& call) {
  return {call.means, call.opacities, call.sizes, call.quats, call.colors};
}

template <class Call>
Gaussians slopes_of(const Call& call) {  // read only
  return {const_cast<float*>(call.by_means), const_cast<float*>(call.by_opacities), const_cast<float*>(call.by_sizes),
          const_cast<float*>(call.by_quats), const_cast<float*>(call.by_colors)};
}

inline Gradients gradients_of(const spawn_backward_call& call) {
  return {call.to_alpha, call.to_geometry, call.to_color, call.to_offsets, call.to_scales, call.to_masks,
          call.to_positions};
}

inline Sample sample_of(const sample_bits_call& call) {
  const int64_t features = call.numbers - 6 - 3 * call.k;
  if (features < 0)
    splatwizard::refuse("%lld numbers are too few for %lld offsets", (long long)call.numbers, (long long)call.k);
  return {call.count, int(features), int(call.k), call.x, call.mean, call.scale, call.steps, call.counted, call.masks,
          float(call.smallest), float(call.smallest_scale)};
}

inline SampleBits bits_of(const sample_bits_call& call) {
  return {call.bits, call.to_x, call.to_mean, call.to_scale, call.to_steps, call.to_masks};
}

}  // namespace sw_anchors
