// Pictures, their gradients, and radii; the work is done by the kernels beside.
#include "face.h"

#include <memory>

#include "face_state.h"

namespace {

using namespace sw;  // NOLINT: one file

template <class S>
void project(project_call& call, const Parallel& parallel) {
  Clock clock;
  const auto view = view_of<S>(call);
  const auto g = gaussians_of<S>(call);
  const auto channels = channels_of(call);
  const auto settings = settings_of(call, parallel);
  const bool surfels = call.flags & kSurfels;
  auto splats = Splats<S>::of(call, channels.total(), call.sh_degree);
  splats.slots.tiles = call.tiles, splats.slots.room = call.room;
  int64_t seen[3] = {0, 0, 0};
  call.used = 0;
  if (g.count > 0)
    call.used = surfels ? SW_SELECT(project_surfels<S>)(view, g, settings, splats.slots, splats.planes, call.radii, seen)
                        : SW_SELECT(project_gaussians<S>)(view, g, settings, channels, splats.slots, call.radii, seen);
  call.seen = seen[0], call.invalid = seen[1], call.listed = seen[2];
  if (call.listed <= call.room) {
    call.pairs = SW_SELECT(count_pairs<S>)(g.count, splats.slots);
    call.list_bytes = Lists<S>(nullptr, view, call.pairs, call.flags).layout.bytes;
    const bool plain = is_plain(channels.total(), channels.colors, call.flags);
    const int columns = surfels ? surfel_columns(call.flags & kWithMaps)
                                : pair_columns(plain, channels.total(), settings.absgrad, settings.median_depth);
    const int64_t shared = g.shape_rows == nullptr ? 0 : g.shapes;
    call.sum_bytes = Sums<S>(nullptr, call.pairs, columns, g.count, shared).layout.bytes;
  }
  call.project_seconds = clock.lap();
}

template <class S>
void draw(draw_call& call, const Parallel& parallel) {
  const auto view = view_of<S>(call);
  const auto settings = settings_of(call.flags, parallel);
  auto splats = Splats<S>::of(call, call.channels, 0);
  auto& slots = splats.slots;
  slots.tiles = const_cast<int32_t*>(call.tiles), slots.room = call.room;
  const auto lists = Lists<S>::of(call, view);
  if (call.used < 0 || call.used > call.count) refuse("%lld splats", (long long)call.used);

  Clock clock;
  const std::unique_ptr<int32_t[]> order(new int32_t[size_t(call.used)]);
  if (call.used > 0) SW_SELECT(depth_order<S>)(call.count, call.used, slots, settings.parallel, order.get());
  call.sort_seconds = clock.lap();
  SW_SELECT(bin_pairs<S>)(view, settings, call.count, call.used, slots, order.get(), lists.pairs);
  call.bin_seconds = clock.lap();
  int64_t counters[2] = {-1, -1};
  if (call.image != nullptr) {
    auto canvas = lists.canvas(call);
    canvas.image = numbers<S>(call.image), canvas.alpha = numbers<S>(call.alpha);
    canvas.median = numbers<S>(call.median);
    if (call.flags & kCount) canvas.counters = counters;
    if (call.flags & kSurfels) {
      if ((call.maps != nullptr) != ((call.flags & kWithMaps) != 0)) refuse("maps and kWithMaps belong together");
      const SurfelCanvas<S> target{canvas, numbers<S>(call.maps), lists.pixels};
      SW_SELECT(blend_surfels<S>)(view, settings, slots, splats.planes, lists.pairs, target);
    } else {
      SW_SELECT(blend<S>)(view, settings, slots, lists.pairs, canvas);
    }
  }
  call.evaluated = counters[0], call.blended = counters[1];
  call.blend_seconds = clock.lap();
}

template <class S>
void draw_backward(draw_backward_call& call, const Parallel& parallel) {
  const auto view = view_of<S>(call);
  const auto g = gaussians_of<S>(call);
  const auto channels = channels_of(call);
  if (call.channels != channels.total()) refuse("a gradient of %lld channels", (long long)call.channels);
  if (!(call.flags & kSave)) refuse("the forward pass kept no state for the backward pass");
  if (call.by_median != nullptr && !(call.flags & kMedianDepth)) refuse("no median depth was drawn");
  if (call.by_maps != nullptr && !(call.flags & kWithMaps)) refuse("no maps were drawn");
  auto settings = settings_of(call, parallel);
  settings.median_depth = call.by_median != nullptr;
  const bool surfels = call.flags & kSurfels, maps = call.by_maps != nullptr;
  const auto splats = Splats<S>::of(call, channels.total(), call.sh_degree);
  const auto lists = Lists<S>::of(call, view);
  const auto canvas = lists.canvas(call);
  const CanvasGradient<S> gradient{numbers<S>(call.by_image), numbers<S>(call.by_alpha), numbers<S>(call.by_median)};
  const bool plain = is_plain(channels.total(), channels.colors, call.flags);
  const int columns = surfels ? surfel_columns(maps)
                              : pair_columns(plain, channels.total(), settings.absgrad, settings.median_depth);
  const bool shared = g.shape_rows != nullptr && (call.of_scales != nullptr || call.of_quats != nullptr);
  const Sums<S> sums(call.sums, call.pairs, columns, g.count, shared ? g.shapes : 0);
  sums.layout.check("sums", call.sum_bytes);
  auto out = gradients_of<S>(call, g);
  out.shape_sums = sums.shapes;

  Clock clock;
  if (surfels)
    SW_SELECT(blend_surfels_backward<S>)(view, settings, splats.slots, splats.planes, lists.pairs,
                                         {canvas, nullptr, lists.pixels}, gradient, numbers<S>(call.by_maps),
                                         sums.pairs);
  else
    SW_SELECT(blend_backward<S>)(view, settings, splats.slots, lists.pairs, canvas, gradient,
                                 settings.detach_features ? channels.features : 0, sums.pairs);
  call.blend_seconds = clock.lap();
  if (g.count == 0) {  // of a table that nobody uses
    if (out.scales != nullptr) std::fill_n(out.scales, call.shapes * call.scale_columns, S(0));
    if (out.quats != nullptr) std::fill_n(out.quats, call.shapes * 4, S(0));
  } else if (surfels) {
    SW_SELECT(project_surfels_backward<S>)(view, g, settings, splats.slots, sums.pairs, maps, out);
  } else {
    SW_SELECT(project_backward<S>)(view, g, settings, channels, splats.slots, sums.pairs, out);
  }
  call.project_seconds = clock.lap();
}

template <class S>
void radii(const visible_radii_call& call, const Parallel& parallel) {
  const auto view = view_of<S>(call);
  const auto g = geometry_of<S>(call);
  const auto settings = settings_of(call, parallel);
  if (g.count == 0) return;
  if (call.flags & kSurfels)
    SW_SELECT(visible_surfel_radii<S>)(view, g, settings, call.radii);
  else
    SW_SELECT(visible_radii<S>)(view, g, settings, call.radii);
}

}  // namespace

SW_OPERATION(sw_rasterizers, plan_splats) {
  return with_numbers(call, [&](auto number, const Parallel&) {
    call->splat_bytes = Splats<decltype(number)>(nullptr, call->count, call->channels, call->color_channels,
                                                 call->sh_degree, call->flags)
                            .layout.bytes;
  });
}

SW_OPERATION(sw_rasterizers, project) {
  return with_numbers(call, [&](auto number, const Parallel& parallel) { project<decltype(number)>(*call, parallel); });
}

SW_OPERATION(sw_rasterizers, draw) {
  return with_numbers(call, [&](auto number, const Parallel& parallel) { draw<decltype(number)>(*call, parallel); });
}

SW_OPERATION(sw_rasterizers, draw_backward) {
  return with_numbers(
      call, [&](auto number, const Parallel& parallel) { draw_backward<decltype(number)>(*call, parallel); });
}

SW_OPERATION(sw_rasterizers, visible_radii) {
  return with_numbers(call, [&](auto number, const Parallel& parallel) { radii<decltype(number)>(*call, parallel); });
}
