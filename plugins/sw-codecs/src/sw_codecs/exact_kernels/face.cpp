// Behind the face: rows of numbers, and their symbols in streams.
#include "face.h"

#include "range_coded.h"
#include "streams_face.h"

namespace {

using namespace splatwizard;

// What is present, as kernels have it, after the number of the first present one of each row went to `start`.
template <class Call>
const uint8_t* present_of(const Call* call) {
  if (call->rows < 0 || call->columns < 0) refuse("rows and columns are negative");
  int64_t count = call->rows * call->columns;
  if (call->present != nullptr) {
    if (call->start == nullptr) refuse("what is present needs start");
    count = 0;
    for (int64_t row = 0; row < call->rows; ++row) {
      call->start[row] = count;
      for (int64_t c = 0; c < call->columns; ++c) count += call->present[row * call->columns + c];
    }
  }
  if (count != call->count) refuse("%lld numbers are present, not %lld", (long long)count, (long long)call->count);
  return reinterpret_cast<const uint8_t*>(call->present);
}

}  // namespace

SW_OPERATION(sw_codecs_exact, lattice) {
  return guarded(call, [&](const Parallel& parallel) {
    const LatticeArgs args{call->mean, call->scale, call->multiplier, call->mean_stride, call->scale_stride,
                           call->multiplier_stride, present_of(call), call->start, call->rows, call->columns,
                           call->thresholds, call->centre, call->number};
    call->status = SW_SELECT(lattice)(args, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, present_rows) {
  return guarded(call, [&](const Parallel& parallel) {
    const PresentArgs args{call->centre, call->number, present_of(call), call->start, call->rows, call->columns,
                           call->to_centre, call->to_number};
    SW_SELECT(present_rows)(args, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, put_values) {
  return guarded(call, [&](const Parallel& parallel) {
    const PutArgs args{call->symbols, present_of(call), call->start, call->step, call->rows, call->columns,
                       call->values, call->values_stride, call->integers};
    SW_SELECT(put_values)(args, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, decode_streams) {
  return guarded(call, [&](const Parallel& parallel) {
    if (call->count < 0 || call->streams != (call->count + STREAM - 1) / STREAM)
      refuse("%lld symbols are not %lld streams", (long long)call->count, (long long)call->streams);
    call->status = SW_SELECT(decode_streams)(tables_of(call), streams_of(call), call->centre, call->number,
                                             call->count, call->symbols, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, encode_streams) {
  return guarded(call, [&](const Parallel& parallel) {
    if (call->count < 0 || call->streams != (call->count + STREAM - 1) / STREAM)
      refuse("%lld symbols are not %lld streams", (long long)call->count, (long long)call->streams);
    const Sinks sinks = sinks_of(call, [&](int64_t s) {
      const int64_t left = call->count - s * STREAM;
      return left < STREAM ? left : STREAM;
    });
    SW_SELECT(encode_streams)(tables_of(call), sinks, call->centre, call->number, call->count, call->symbols, parallel);
    call->written = join(sinks);
  });
}

SW_OPERATION(sw_codecs_exact, decode_octree) {
  return guarded(call, [&](const Parallel&) {
    if (call->depth < 0 || call->depth > 21 || call->points < 1 || call->points >= int64_t{1} << 40)
      refuse("%lld levels of at most %lld nodes", (long long)call->depth, (long long)call->points);
    call->status = SW_SELECT(decode_octree)({call->words, call->bytes, call->depth, call->points, call->counts},
                                            call->nodes, call->occupancies, call->sizes);
  });
}

SW_OPERATION(sw_codecs_exact, decode_bits) {
  return guarded(call, [&](const Parallel&) {
    if (call->zeros < 1 || call->zeros >= 1 << 24 || call->count < 0) refuse("zeros must be 1 .. 2^24 - 1");
    call->status = SW_SELECT(decode_bits)(call->words, call->bytes, static_cast<uint32_t>(call->zeros), call->count,
                                          call->bits);
  });
}
