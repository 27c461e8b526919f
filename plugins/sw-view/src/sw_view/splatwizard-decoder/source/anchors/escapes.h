// Escape codes behind range-coded words, of which nothing else says how long they are (docs/bitstream.md, gaussian-exact).
#pragma once
#include <rans.h>

#include "base.h"

namespace swz {

struct Escapes {
  arch_native::EscapeReader bits;

  Escapes(Bytes data, int64_t count) : bits(data.data, data.left) {
    if (count > 4 * data.left)
      refuse(grouped(data.left), " bytes cannot hold ", grouped(count), " escape codes: the data is truncated");
  }
  // What is beyond a radius, signed.
  int64_t beyond(int64_t radius) {
    const int64_t found = bits.beyond(radius), size = found < 0 ? -found : found;
    if (bits.damaged) refuse("an escape code is damaged or truncated");
    too_large |= size - radius > 2 * splatwizard::SYMBOL_LIMIT;
    return found;
  }
  void finish(bool is_limited = true) const {
    if (!bits.used_up()) refuse("unknown bits follow the escape codes");
    if (is_limited && too_large) refuse("an escaped symbol is beyond 2^30");
  }

 private:
  bool too_large = false;
};

inline Bytes whole_words(Bytes words) {
  if (words.left % 4) refuse(grouped(words.left), " coded bytes are not whole 32-bit words");
  return words;
}

// Rows of entries that are escapes, in the order of coding: table by table.
inline Buffer<int64_t> escaped_rows(const int32_t* entries, const int16_t* number, int64_t n, const int32_t* radii) {
  int64_t next[513] = {};
  for (int64_t i = 0; i < n; ++i) next[number[i] + 1] += entries[i] > 2 * radii[number[i]];
  for (int t = 0; t < 512; ++t) next[t + 1] += next[t];
  Buffer<int64_t> rows(next[512]);
  for (int64_t i = 0; i < n; ++i)
    if (entries[i] > 2 * radii[number[i]]) rows[next[number[i]]++] = i;
  return rows;
}

}  // namespace swz
