// Gaussians that anchors spawn, from outputs of networks or together with the networks.
#include <algorithm>

#include "calls.h"
#include "kernels.h"

using namespace sw_anchors;
using splatwizard::refuse;

namespace {

void check_drawn(const Anchors& from) {
  const auto wrong = [&](int64_t i) {
    return from.drawn[i] < 0 || from.drawn[i] >= from.n * from.k || (i > 0 && from.drawn[i] <= from.drawn[i - 1]);
  };
  bool any = false;  // without branches, in vectors
  for (int64_t i = 1; i < from.count; ++i) any |= from.drawn[i] <= from.drawn[i - 1];
  if (from.count == 0 || !(any || wrong(0) || wrong(from.count - 1))) return;
  int64_t i = 0;
  while (!wrong(i)) ++i;
  refuse("Gaussian %lld of %lld is drawn out of order", (long long)from.drawn[i], (long long)(from.n * from.k));
}

template <class Call>
Heads heads_of(const Call& call) {
  Heads heads{};
  heads.features = call.inputs, heads.hidden = call.units;
  if (call.inputs < 1 || call.units < 1)
    refuse("networks of %lld features and %lld units", (long long)call.inputs, (long long)call.units);
  const float* const last[kHeads] = {call.opacity, call.geometry, call.color};
  const float* const last_bias[kHeads] = {call.opacity_bias, call.geometry_bias, call.color_bias};
  for (int h = 0; h < kHeads; ++h) {
    heads.first[h] = call.first[h], heads.first_bias[h] = call.first_bias[h];
    heads.last[h] = last[h], heads.last_bias[h] = last_bias[h];
  }
  if (call.rows != SW_SELECT(heads_rows)(call.n) || call.width != SW_SELECT(heads_width)(heads))
    refuse("hidden layers of %lld anchors do not stand in %lld rows of %lld", (long long)call.n, (long long)call.rows,
           (long long)call.width);
  return heads;
}

}  // namespace

SW_OPERATION(sw_anchors, spawn) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const Anchors from = outputs_of(*call);
    check_drawn(from);
    SW_SELECT(spawn)(from, spawned_of(*call), parallel);
  });
}

SW_OPERATION(sw_anchors, spawn_backward) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const Anchors from = outputs_of(*call);
    check_drawn(from);
    SW_SELECT(spawn_backward)(from, slopes_of(*call), gradients_of(*call), parallel);
  });
}

SW_OPERATION(sw_anchors, heads_sizes) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel&) {
    if (call->units < 1) refuse("networks of %lld units", (long long)call->units);
    Heads heads{};
    heads.hidden = call->units;
    call->block = SW_SELECT(heads_rows)(1), call->width = SW_SELECT(heads_width)(heads);
  });
}

SW_OPERATION(sw_anchors, heads_opacities) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const Anchors from = anchors_of(*call);
    const Seen seen{call->center, call->features, call->feature_row};
    SW_SELECT(heads_opacities)(from, seen, heads_of(*call), call->hidden, call->alpha, call->opacities, parallel);
    call->count = std::count_if(call->opacities, call->opacities + from.n * from.k, [](float x) { return x > 0.f; });
  });
}

SW_OPERATION(sw_anchors, heads_spawn) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    Anchors from = anchors_of(*call);
    int64_t found = 0;
    for (int64_t i = 0; i < from.n * from.k; ++i) {
      if (!(call->all_opacities[i] > 0.f)) continue;
      if (found < call->count) call->drawn[found] = i;
      ++found;
    }
    if (found != call->count)
      refuse("%lld Gaussians have opacity > 0, not %lld", (long long)found, (long long)call->count);
    set_rows(*call, from);
    from.geometry = call->raw_geometry, from.color = call->raw_color, from.compact = true;
    SW_SELECT(heads_spawn)(from, heads_of(*call), call->hidden, call->raw_geometry, call->raw_color,
                           {call->means, call->opacities, call->sizes, call->quats, call->colors}, parallel);
  });
}

SW_OPERATION(sw_anchors, heads_backward) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    Anchors from = anchors_of(*call);
    set_rows(*call, from), check_drawn(from);
    from.geometry = call->raw_geometry, from.color = call->raw_color, from.compact = true;
    const Gradients to{call->scratch_alpha, call->scratch_geometry, call->scratch_color, call->to_offsets,
                       call->to_scales,     call->to_masks,         nullptr};
    HeadGradients to_heads{{}, {}, {call->to_opacity, call->to_geometry, call->to_color},
                           {call->to_opacity_bias, call->to_geometry_bias, call->to_color_bias}};
    std::copy_n(call->to_first, kHeads, to_heads.first), std::copy_n(call->to_first_bias, kHeads, to_heads.first_bias);
    SW_SELECT(heads_backward)(from, {call->center, call->features, call->feature_row}, heads_of(*call), call->hidden,
                              slopes_of(*call), to, call->to_features, to_heads, parallel);
  });
}
