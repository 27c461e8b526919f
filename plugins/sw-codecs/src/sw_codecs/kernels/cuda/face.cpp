#include "face.h"

#include <splatwizard/cuda_face.h>

#include <limits>

#include "../calls.h"
#include "kernels.h"
#include "plane_bits.h"
#include "triplane.h"

using splatwizard::guarded_on_gpu;
using splatwizard::refuse;

namespace {

bool starts_at_multiple(const void* address, size_t bytes) { return reinterpret_cast<uintptr_t>(address) % bytes == 0; }

template <class Call>
sw_grid::Levels features_of(const Call* call, const float* table) {
  // Pairs are read and added as one number of eight bytes.
  if (call->features == 2 && !starts_at_multiple(table, 8)) refuse("a table of pairs must start at a multiple of 8 bytes");
  return sw_grid::features_of(call, sw_grid::kMaxFeatures);
}

// Sums of whole numbers, of at most `count` floats each; only where `largest` is handed over.
template <class Call>
sw_sums::Sums sums_of(const Call* call, int64_t count) {
  if (call->sums == nullptr && call->entries > 0) refuse("sums in any order need room");
  return {reinterpret_cast<sw_sums::Whole*>(call->sums), call->largest, count};
}

template <class Call>
bool are_fours(const Call* call, const sw_grid::Signs& at, const float* features) {
  return at.features == 4 && at.row % 4 == 0 && starts_at_multiple(call->table, 16) && starts_at_multiple(features, 16);
}

template <class Call>
sw_planes::Planes planes_of(const Call& call) {
  using namespace sw_planes;
  if (call.scales < 1 || call.scales > kScales) refuse("planes of 1 to %d sizes are offered", kScales);
  Planes at{};
  at.scales = int(call.scales), at.orientations = int(call.orientations), at.channels = int(call.channels);
  for (int i = 0; i < at.scales; ++i) {
    const int64_t most = std::numeric_limits<int32_t>::max();
    if (call.channels < 0 || call.heights[i] < 0 || call.widths[i] < 0 || call.heights[i] > most ||
        call.widths[i] > most || call.channels > most / std::max<int64_t>(call.heights[i] * call.widths[i], 1))
      refuse("planes of %lld x %lld x %lld are not offered", (long long)call.channels, (long long)call.heights[i],
             (long long)call.widths[i]);
    at.height[i] = int(call.heights[i]), at.width[i] = int(call.widths[i]);
    at.count[i] = int64_t(at.channels) * at.height[i] * at.width[i];
  }
  return at;
}

template <class Call>
sw_triplane::Sites sites_of(const Call& call) {
  using namespace sw_triplane;
  if (call.scales < 1 || call.scales > kScales || call.channels < 1 || call.channels > 1 << 20 ||
      call.width != call.scales * kPairs * call.channels)
    refuse("planes of %lld sizes and %lld channels do not fit", (long long)call.scales, (long long)call.channels);
  return {call.count, int(call.scales), int(call.channels), call.cells, call.weights};
}

// A list has a tensor for each scale that has places, and for all if there are sites.
template <class Call, class Number>
void check_all(const Call& call, Number* const (&list)[4]) {
  for (int i = 0; i < int(call.scales); ++i)
    if (list[i] == nullptr && (call.places[i] > 0 || call.count > 0)) refuse("a tensor of scale %d is missing", i);
}

bool in_fours(const sw_triplane::Sites& sites, const float* features) {
  return sites.channels % 4 == 0 && starts_at_multiple(features, 16);
}

}  // namespace

SW_OPERATION(sw_codecs_cuda, grid_lookup) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const sw_grid::Levels levels = features_of(call, call->values);
    if (call->count > 0)
      sw_grid::cuda::lookup(levels, int(call->axes), int(call->features), call->count, call->x, call->values,
                            call->found, stream);
  });
}

SW_OPERATION(sw_codecs_cuda, grid_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const sw_grid::Levels levels = features_of(call, call->table);
    const int axes = int(call->axes), features = int(call->features);
    if (call->count > 0 && call->largest != nullptr) {
      const sw_sums::Sums sums = sums_of(call, call->count << axes);
      sw_grid::cuda::backward(levels, axes, features, call->count, call->x, call->gradient, sums, stream);
      sw_grid::cuda::add_sums(sums, call->entries * call->features, call->table, stream);
    } else if (call->count > 0) {
      sw_grid::cuda::backward(levels, axes, features, call->count, call->x, call->gradient, call->table, stream);
    }
  });
}

SW_OPERATION(sw_codecs_cuda, signs_lookup) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const sw_grid::Signs at = sw_grid::signs_of(call);
    float* const to = call->found + call->first;
    if (at.count > 0) sw_grid::cuda::signs_lookup(at, are_fours(call, at, to), call->table, to, stream);
  });
}

SW_OPERATION(sw_codecs_cuda, signs_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const sw_grid::Signs at = sw_grid::signs_of(call);
    const float* const from = call->gradient + call->first;
    const bool four = are_fours(call, at, from);
    if (at.count > 0 && call->largest != nullptr) {
      const sw_sums::Sums sums = sums_of(call, at.count << at.axes);
      sw_grid::cuda::signs_backward(at, four, from, sums, stream);
      sw_grid::cuda::add_sums(sums, call->entries * call->features, call->table, stream);
    } else if (at.count > 0) {
      sw_grid::cuda::signs_backward(at, four, from, call->table, stream);
    }
  });
}

SW_OPERATION(sw_codecs_cuda, plane_bits_sizes) {
  return guarded_on_gpu(call, [&](cudaStream_t) { call->parts = sw_planes::cuda::parts_of(planes_of(*call)); });
}

SW_OPERATION(sw_codecs_cuda, plane_bits) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    sw_planes::Planes at = planes_of(*call);
    for (int i = 0; i < at.scales; ++i) {
      if (call->planes[i] == nullptr && at.orientations * at.count[i] > 0) refuse("planes of scale %d are missing", i);
      at.values[i] = call->planes[i], at.to[i] = call->to_planes[i], at.parts[i] = call->ordered[i];
      const int64_t needed = at.orientations * part_sums(at, i);
      if (at.parts[i] != nullptr && (at.to[i] == nullptr || call->ordered_counts[i] < needed))
        refuse("sums of scale %d in one order need %lld numbers", i, (long long)needed);
    }
    const int64_t parts = sw_planes::cuda::parts_of(at);
    if (call->parts != parts) refuse("there are %lld parts, not %lld", (long long)parts, (long long)call->parts);
    sw_planes::cuda::bits(at, call->parameters, call->partial, stream);
  });
}

SW_OPERATION(sw_codecs_cuda, triplane_lookup) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const sw_triplane::Sites sites = sites_of(*call);
    check_all(*call, call->planes), check_all(*call, call->tables);
    sw_triplane::cuda::Tables tables{};
    for (int i = 0; i < sites.scales; ++i) {
      tables.of[i] = call->tables[i];
      sw_triplane::cuda::transpose(call->planes[i], tables.of[i], sw_triplane::kPairs, sites.channels, call->places[i],
                                   float(call->gain), stream);
    }
    sw_triplane::cuda::lookup(sites, in_fours(sites, call->features), tables, call->features, stream);
  });
}

SW_OPERATION(sw_codecs_cuda, triplane_backward) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) {
    const sw_triplane::Sites sites = sites_of(*call);
    const bool whole = call->largest != nullptr, four = in_fours(sites, call->slopes);
    whole ? check_all(*call, call->sums) : check_all(*call, call->tables);
    check_all(*call, call->to_planes);
    sw_triplane::cuda::Tables tables{};
    // A slope is that of its own scale and of all finer ones; corners may fall together.
    sw_triplane::cuda::SumTables sums{{}, call->largest, sites.count * sites.scales * sw_triplane::kCorners};
    for (int i = 0; i < sites.scales; ++i)
      tables.of[i] = call->tables[i], sums.of[i] = reinterpret_cast<sw_sums::Whole*>(call->sums[i]);
    if (whole)
      sw_triplane::cuda::backward(sites, four, call->slopes, sums, stream);
    else
      sw_triplane::cuda::backward(sites, four, call->slopes, tables, stream);
    for (int i = 0; i < sites.scales; ++i) {
      float* const to = call->to_planes[i];
      if (whole)
        sw_triplane::cuda::transpose(sw_sums::Sums{sums.of[i], sums.largest, sums.count}, to, sw_triplane::kPairs,
                                     call->places[i], sites.channels, stream);
      else
        sw_triplane::cuda::transpose(tables.of[i], to, sw_triplane::kPairs, call->places[i], sites.channels, 0.f,
                                     stream);
    }
  });
}
