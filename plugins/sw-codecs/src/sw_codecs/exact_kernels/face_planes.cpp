// Behind the face: integer planes of several scales in streams.
#include "streams_face.h"

namespace {

using namespace splatwizard;

static_assert(sizeof(PlaneStream) == 4 * sizeof(int64_t), "a row of parts is a PlaneStream");

// Streams of the planes of a call, checked, and put together in bundles.
template <class Call>
PlanesArgs planes_of(const Call* call) {
  PlanesArgs args{};
  if (call->scales < 1 || call->scales > 4) refuse("one to four scales of planes");
  for (int64_t i = 0; i < call->scales; ++i) {
    args.planes[i] = const_cast<int32_t*>(call->planes[i]);  // an encoder reads them
    args.channels[i] = call->channels[i];
    args.height[i] = call->height[i];
    args.width[i] = call->width[i];
  }
  args.weights = call->weights;
  const auto* streams = reinterpret_cast<const PlaneStream*>(call->parts);
  int64_t bundles = 0;
  for (int64_t s = 0; s < call->streams; ++s) {
    const PlaneStream& stream = streams[s];
    if (stream.scale < 0 || stream.scale >= call->scales || stream.orientation < 0 ||
        stream.orientation >= call->orientations || stream.channel < 0 || stream.channels < 1 ||
        stream.channels > call->channels[stream.scale] - stream.channel)
      refuse("stream %lld lies outside the planes", (long long)s);
    bool joins = false;
    if (s > 0) {
      const PlaneStream &last = streams[s - 1], &first = streams[call->bundles[bundles - 1]];
      joins = last.scale == stream.scale && last.orientation == stream.orientation &&
              last.channel + last.channels == stream.channel && stream.channel + stream.channels - first.channel <= 8;
    }
    if (!joins) call->bundles[bundles++] = s;
  }
  call->bundles[bundles++] = call->streams;
  args.streams = streams;
  args.count = call->streams;
  args.bundle = call->bundles;
  args.bundles_end = call->bundles + bundles;
  return args;
}

}  // namespace

SW_OPERATION(sw_codecs_exact, decode_planes) {
  return guarded(call, [&](const Parallel& parallel) {
    const PlanesArgs args = planes_of(call);
    call->status = SW_SELECT(decode_planes)(tables_of(call), streams_of(call), args, parallel);
  });
}

SW_OPERATION(sw_codecs_exact, encode_planes) {
  return guarded(call, [&](const Parallel& parallel) {
    const PlanesArgs args = planes_of(call);
    const Sinks sinks = sinks_of(call, [&](int64_t s) {
      const PlaneStream& stream = args.streams[s];
      return stream.channels * args.height[stream.scale] * args.width[stream.scale];
    });
    SW_SELECT(encode_planes)(tables_of(call), sinks, args, parallel);
    call->written = join(sinks);
  });
}
