#include "calls.h"
#include "kernels.h"

namespace {

using namespace splatwizard;

template <class Call>
sw_sites::Sites sites_of(const Call* call) {
  if (call->scales < 1 || call->scales > sw_sites::kMaxScales) refuse("1 to %d scales", sw_sites::kMaxScales);
  if (call->channels < 1 || call->channels >= 1 << 20 ||
      call->width != call->scales * sw_sites::kPlanes * call->channels)
    refuse("features do not fit");
  sw_sites::Sites at{};
  at.count = call->count, at.scales = int(call->scales), at.channels = int(call->channels);
  at.cells = call->cells, at.weights = call->weights;
  return at;
}

}  // namespace

SW_OPERATION(sw_codecs, grid_lookup) {
  return guarded(call, [&](const Parallel& parallel) {
    SW_SELECT(grid_lookup)(sw_grid::features_of(call, 1 << 20), int(call->axes), int(call->features), call->count, call->x, call->values,
                           call->found, parallel);
  });
}

SW_OPERATION(sw_codecs, grid_backward) {
  return guarded(call, [&](const Parallel& parallel) {
    SW_SELECT(grid_backward)(sw_grid::features_of(call, 1 << 20), int(call->axes), int(call->features), call->count, call->x,
                             call->gradient, call->table, parallel);
  });
}

SW_OPERATION(sw_codecs, signs_lookup) {
  return guarded(call, [&](const Parallel& parallel) {
    const sw_grid::Signs at = sw_grid::signs_of(call);
    if (at.count > 0) SW_SELECT(signs_lookup)(at, call->table, call->found + call->first, parallel);
  });
}

SW_OPERATION(sw_codecs, signs_backward) {
  return guarded(call, [&](const Parallel& parallel) {
    const sw_grid::Signs at = sw_grid::signs_of(call);
    if (at.count > 0) SW_SELECT(signs_backward)(at, call->gradient + call->first, call->table, parallel);
  });
}

SW_OPERATION(sw_codecs, sites_lookup) {
  return guarded(call, [&](const Parallel& parallel) {
    sw_sites::Sites at = sites_of(call);
    for (int s = 0; s < at.scales; ++s) at.rows[s] = call->rows[s];
    if (!SW_SELECT(sites_lookup)(at, call->tables, call->found, parallel)) refuse("a cell lies outside its table");
  });
}

SW_OPERATION(sw_codecs, sites_backward) {
  return guarded(call, [&](const Parallel& parallel) {
    SW_SELECT(sites_backward)(sites_of(call), call->gradient, call->tables, parallel);
  });
}

SW_OPERATION(sw_codecs, huffman_decode) {
  return guarded(call, [&](const Parallel&) {
    if (call->trees < 1 || call->alphabet < 2 || call->trees > (int64_t(1) << 28) / call->alphabet) refuse("malformed counts");
    for (int64_t i = 0; i < call->count; ++i)
      if (call->index[i] < 0 || call->index[i] >= call->trees)
        refuse("a symbol has table %lld of %lld", (long long)call->index[i], (long long)call->trees);
    call->sufficed = SW_SELECT(huffman_decode)(call->bytes, call->length, call->counts, call->trees, call->alphabet,
                                               call->index, call->count, call->symbols);
  });
}

SW_OPERATION(sw_codecs, nearest_entries) {
  return guarded(call, [&](const Parallel& parallel) {
    if (call->choices < 1 || call->dimensions < 1 || call->dimensions > 1 << 16)
      refuse("rows must have 1 to 65,536 numbers, and entries must be there");
    call->share = SW_SELECT(nearest_entries)(call->rows, call->count, call->entries, call->choices, int(call->dimensions),
                                             call->index, parallel);
  });
}
