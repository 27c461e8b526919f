// Behind the face: symbols of several models from one stream.
#include "face.h"

#include "range_coded.h"
#include "streams_face.h"

namespace {

using namespace splatwizard;

template <class Call>
RangeSession session_of(const Call* call) {
  if (call->state[3] < 0 || call->state[3] > call->bytes / 4) refuse("a stream cannot have read so many words");
  if (static_cast<uint64_t>(call->state[1]) < uint64_t{1} << 32) refuse("the range of a stream is too small");
  return {call->words, call->bytes, call->state};
}

}  // namespace

SW_OPERATION(sw_codecs_exact, range_bits) {
  return guarded(call, [&](const Parallel&) {
    for (int64_t i = 0; i < call->count; ++i)
      if (call->zeros[i] < 1 || call->zeros[i] >= 1 << 24) refuse("zeros must be 1 .. 2^24 - 1");
    call->status = SW_SELECT(range_bits)(session_of(call), call->zeros, call->count, call->bits);
  });
}

SW_OPERATION(sw_codecs_exact, range_entries) {
  return guarded(call, [&](const Parallel&) {
    for (int64_t i = 0; i < call->count; ++i)
      if (call->number[i] < 0 || call->number[i] >= 512) refuse("table %d of 512", int{call->number[i]});
    call->status =
        SW_SELECT(range_entries)(session_of(call), tables_of(call), call->number, call->count, call->entries);
  });
}

SW_OPERATION(sw_codecs_exact, range_choices) {
  return guarded(call, [&](const Parallel&) {
    for (int64_t i = 0; i < 3 * call->count; ++i)
      if (!(call->counts[i] > 0) || call->counts[i] > 1e12) refuse("counts must be above 0");
    call->status = SW_SELECT(range_choices)(session_of(call), call->counts, call->count, call->entries);
  });
}

SW_OPERATION(sw_codecs_exact, decode_leaf_octree) {
  return guarded(call, [&](const Parallel&) {
    for (int64_t i = 0; i < 2960; ++i)
      if (call->zeros[i] < 1 || call->zeros[i] >= 1 << 24) refuse("zeros must be 1 .. 2^24 - 1");
    for (int level = 0; level < 16; ++level)
      if (call->known_start[level] > call->known_start[level + 1]) refuse("known cells are out of order");
    if (call->known_start[0] != 0 || call->known_start[16] != call->known || call->rows < 0 ||
        call->rows >= int64_t{1} << 31)
      refuse("shapes do not fit");
    call->status = SW_SELECT(decode_leaf_octree)(
        session_of(call), {call->zeros, call->known_start, call->known_cells, call->known_counts, call->rows},
        call->levels, call->codes);
  });
}
