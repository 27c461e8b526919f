// Bits under one share of ones, range coded (sw_codecs.coders.arithmetic).
#include "range_coded.h"
#include "ranges.h"

namespace SW_ARCH {

using namespace splatwizard;

int32_t decode_bits(const uint8_t* words, int64_t bytes, uint32_t zeros, int64_t count, int32_t* bits) {
  RangeReader coded(words, bytes);
  for (int64_t i = 0; i < count; ++i) {
    const int one = coded.bit(zeros);
    if (one < 0) return WORDS_LEFT;
    bits[i] = one;
  }
  return FINE;
}

}  // namespace SW_ARCH
