// Words of the range coder, as the library constriction has them (docs/bitstream.md, range coder).
#pragma once
#include "rans.h"

namespace SW_ARCH {

constexpr uint64_t TOP = uint64_t{1} << BITS;

struct RangeReader {
  const uint8_t* words;
  int64_t count, at = 0;  // behind the last word come zeros
  uint64_t low = 0, range = ~uint64_t{0}, point, scale = 0;

  RangeReader(const uint8_t* data, int64_t bytes) : words(data), count(bytes / 4) {
    point = next() << 32;
    point |= next();
  }
  // Which of 2^24 parts of the range is meant; 2^24 or more if the data is damaged.
  uint64_t quantile() {
    scale = range >> BITS;
    return (point - low) / scale;
  }
  // Goes on behind an entry with the shares from `first` to below `last`.
  void take(uint64_t first, uint64_t last) {
    low += scale * first;
    range = scale * (last - first);
    if (range < uint64_t{1} << 32) {
      low <<= 32;
      range <<= 32;
      point = point << 32 | next();
    }
  }
  // A bit, 0 having `zeros` parts; -1 if the data is damaged. Without the division of `quantile`.
  int bit(uint64_t zeros) {
    scale = range >> BITS;
    const uint64_t offset = point - low, border = scale * zeros;
    if (offset >= scale << BITS) return -1;
    const bool one = offset >= border;
    low += one ? border : 0;
    range = one ? (scale << BITS) - border : border;
    if (range < uint64_t{1} << 32) {
      low <<= 32;
      range <<= 32;
      point = point << 32 | next();
    }
    return one;
  }

 private:
  uint64_t next() { return at < count ? word_at(words + 4 * at++) : 0u; }
};

}  // namespace SW_ARCH
