// Gradients in two operations, so that what the first one needs, the image's gradient and the lists, is free again
// before the second one has room for the gradients of the inputs, which are larger than all else.
#include "face.h"

#include "face_state.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

int64_t row_length_of(int64_t channels, int64_t flags, bool maps) {
  if (flags & kSurfels) return surfel_columns(maps);
  return row_length(int(channels), flags & kAbsgrad, flags & kMedianDepth);
}

// Numbers of a pair that are summed up in one order.
int64_t pair_floats(int64_t channels, int64_t colors, int64_t flags, bool maps) {
  if (flags & kSurfels) return surfel_columns(maps);
  return pair_row_length(channels != 3 || colors != 3 || (flags & kMedianDepth), flags & kAbsgrad);
}

void blend_backward(blend_backward_call& call, cudaStream_t stream) {
  check_floats(call);
  const auto view = view_of<float>(call);
  const Way way(view, call.channels, call.color_channels, call.flags);
  const ListMemory kept = ListMemory::of(call, view, way);
  const bool absgrad = call.flags & kAbsgrad, median = call.flags & kMedianDepth, maps = call.by_maps != nullptr;
  if (call.by_median != nullptr && !median) refuse("no median depth was drawn");
  if (maps && !(call.flags & kWithMaps)) refuse("no maps were drawn");
  const int64_t length = row_length_of(call.channels, call.flags, maps);
  if (call.row_length != length) refuse("rows of %lld sums, not %lld", (long long)call.row_length, (long long)length);
  StageClock clock{(call.flags & kCount) != 0, stream};
  clock.mark();
  check(cudaMemsetAsync(call.rows, 0, size_t(call.count * length) * sizeof(float), stream));
  const Image image = kept.image(call, tiles_of(view), call.pairs);
  const ImageGradient gradient{numbers<float>(call.by_image), numbers<float>(call.by_alpha),
                               numbers<float>(call.by_median)};
  const TileLists lists{kept.tile_start, call.pair_splats};
  const int32_t* const of_pixel = gradient.median != nullptr ? kept.median_splat : nullptr;
  const Ordered ordered = ordered_of(call, pair_floats(call.channels, call.color_channels, call.flags, maps), of_pixel,
                                     int64_t(view.width) * view.height, stream);
  if (call.pairs > 0 && way.surfels) {
    blend_surfels_backward(view, settings_of(call.flags, nullptr), kept.splats, lists, {image, nullptr, kept.pixels},
                           gradient, numbers<float>(call.by_maps), call.rows, ordered, stream);
  } else if (call.pairs > 0) {
    const Rows rows{call.rows, length, int(call.channels), absgrad, median, (call.flags & kFragments) != 0};
    cuda::blend_backward(view, call.flags & kPassClamp, kept.splats, lists, image, way.general, gradient,
                         call.flags & kDetachFeatures ? int(call.feature_channels) : 0, rows, ordered, stream);
  }
  check(cudaGetLastError());
  clock.mark();
  call.blend_seconds = clock.seconds(0);
}

// Adam of a tensor where its gradient is found; without moments there is none.
RowAdam adam_of(const sw_real* param, float* exp_avg, float* exp_avg_sq, const double* rates) {
  if (exp_avg == nullptr || exp_avg_sq == nullptr || param == nullptr) return {};
  for (const void* each : {static_cast<const void*>(param), static_cast<const void*>(exp_avg),
                           static_cast<const void*>(exp_avg_sq)})
    if (reinterpret_cast<uintptr_t>(each) % 16 != 0)
      refuse("sw_rasterizers: parameter and moments must start at multiples of 16 bytes");
  return {const_cast<float*>(numbers<float>(param)), exp_avg, exp_avg_sq, float(rates[0]), float(rates[1]),
          float(rates[2]), float(rates[3]), float(rates[4]), float(rates[5])};
}

void project_backward(project_backward_call& call, cudaStream_t stream) {
  check_floats(call);
  const auto view = view_of<float>(call);
  const auto g = gaussians_of<float>(call);
  const auto channels = channels_of(call);
  const auto settings = settings_of(call, nullptr);
  const bool absgrad = call.flags & kAbsgrad, median = call.flags & kMedianDepth;
  const int64_t length = row_length_of(channels.total(), call.flags, call.maps);
  if (call.row_length != length) refuse("rows of %lld sums, not %lld", (long long)call.row_length, (long long)length);
  const auto out = gradients_of<float>(call, g);
  const ShAdam adam{adam_of(call.sh_dc, call.dc_exp_avg, call.dc_exp_avg_sq, call.dc_rates),
                    adam_of(call.sh_rest, call.rest_exp_avg, call.rest_exp_avg_sq, call.rest_rates)};
  StageClock clock{(call.flags & kCount) != 0, stream};
  clock.mark();
  if (g.count > 0 && (call.flags & kSurfels)) {
    if (adam.any()) refuse("Adam's step in the backward pass is not offered for surfels");
    project_surfels_backward(view, g, settings, call.drawn, call.rows, call.maps, out, stream);
  } else if (g.count > 0) {
    const Rows rows{const_cast<float*>(call.rows), length, channels.total(), absgrad, median,
                    (call.flags & kFragments) != 0};
    cuda::project_backward(view, g, settings, channels, call.drawn, rows, out, adam, stream);
  }
  check(cudaGetLastError());
  clock.mark();
  call.project_seconds = clock.seconds(0);
}

}  // namespace

SW_OPERATION(sw_rasterizers_cuda, plan_sums) {
  return guarded_on_gpu(call, [&](cudaStream_t) {
    const bool ordered = (call->flags & kOrdered) && call->pairs > 0;
    const auto bytes = [&](int64_t floats, int64_t pixels) {
      if (!ordered) return int64_t(0);
      return SumMemory(nullptr, call->pairs, call->used, floats, pixels, call->count).layout.bytes;
    };
    call->row_length = row_length_of(call->channels, call->flags, call->maps);
    call->blend_bytes = bytes(pair_floats(call->channels, call->color_channels, call->flags, call->maps), call->pixels);
    call->score_bytes = bytes(kScoreParts, 0);
    call->fisher_bytes = bytes(kFisherParts * kFisherSums, 0);
  });
}

SW_OPERATION(sw_rasterizers_cuda, blend_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) { blend_backward(*call, stream); });
}

SW_OPERATION(sw_rasterizers_cuda, project_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) { project_backward(*call, stream); });
}
