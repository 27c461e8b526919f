// What the files behind the face share: where streams lie.
#pragma once
#include <cstring>

#include "face.h"
#include "kernels.h"

namespace splatwizard {

// The tables of a call.
template <class Call>
Tables tables_of(const Call* call) {
  return {call->shares, call->first, call->radius, call->bucket};
}

// Streams of `data`, which they must fill.
template <class Call>
Streams streams_of(const Call* call) {
  int64_t at = 0;
  for (int64_t s = 0; s < call->streams; ++s) {
    const int64_t words = call->sizes[3 * s + 1], escapes = call->sizes[3 * s + 2], left = call->bytes - at;
    if (words < 0 || escapes < 0 || words > left || escapes > left - words) refuse("streams end behind the data");
    call->offsets[s] = at;
    at += words + escapes;
  }
  if (at != call->bytes) refuse("data behind the last stream");
  return {call->data, call->sizes, call->offsets, call->streams};
}

// Room for streams, of which number s has counted(s) symbols.
template <class Call, class Counted>
Sinks sinks_of(const Call* call, const Counted& counted) {
  int64_t bytes = 0;
  for (int64_t s = 0; s < call->streams; ++s) {
    call->offsets[s] = bytes;
    bytes += most_bytes(counted(s));
  }
  if (bytes > call->room) refuse("streams need room for %lld bytes, not %lld", (long long)bytes, (long long)call->room);
  return {call->data, call->offsets, call->sizes, call->streams};
}

// Closes the gaps between streams; bytes of all.
inline int64_t join(const Sinks& sinks) {
  uint8_t* to = sinks.data;
  for (int64_t s = 0; s < sinks.count; ++s) {
    const int64_t size = sinks.table[3 * s + 1] + sinks.table[3 * s + 2];
    std::memmove(to, sinks.data + sinks.offset[s], static_cast<size_t>(size));
    to += size;
  }
  return to - sinks.data;
}

}  // namespace splatwizard
