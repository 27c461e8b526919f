// Which table codes each number, and about which integer, from means and scales in float64.
#pragma once
#include "kernels.h"
#include "rans.h"
#include "vectors.h"

namespace SW_ARCH {

constexpr int BUCKETS = 16 * 34;  // sixteen of each octave below 2^34, which is above the last threshold
constexpr int COLUMNS = 64;       // of a row, worked out together
static_assert(COLUMNS % LANES == 0);

struct Levels {
  int32_t first[BUCKETS];  // number of thresholds below the smallest number of a bucket
  double threshold[64];
  bool several = false;  // whether a bucket has more than one, which is not so for the shipped ones

  explicit Levels(const int64_t* thresholds) {
    for (int i = 0; i < 63; ++i) threshold[i] = static_cast<double>(thresholds[i]);
    threshold[63] = 1e300;
    for (int i = 0; i < BUCKETS; ++i) {
      const uint64_t bits = (uint64_t{1023 * 16} + static_cast<uint64_t>(i)) << 48;
      double low;
      std::memcpy(&low, &bits, 8);
      first[i] = 0;
      while (i > 0 && threshold[first[i]] < low) ++first[i];
      several |= i > 0 && first[i] > first[i - 1] + 1;
    }
    several |= first[BUCKETS - 1] < 63;
  }
};

// Buckets of ratios, which are integers: 0 has no positive exponent.
inline Narrow buckets_of(Vec ratio) {
  constexpr IntVec BASE = IntVec{} + 1023 * 16, LAST = IntVec{} + (BUCKETS - 1);
  IntVec i = (reinterpret_cast<IntVec>(ratio) >> 48) - BASE;
  i = i < 0 ? IntVec{} : i;
  i = i > LAST ? LAST : i;
  return __builtin_convertvector(i, Narrow);
}

// Integer parts and table numbers of up to COLUMNS columns of a row; whether an integer part is beyond the limit.
//
// All take whole vectors: what is behind the last column is read, written and of no use. Means and scales are integers
// below 2^48. Quotients are taken in float64: with a dividend below 2^53 and a divisor m, floor of the rounded quotient
// q is exact as long as q 2^-53 < 1 / m; what is beyond is refused, or far above the last threshold.
inline bool columns_of(const Levels& levels, const double* mean, const double* scale, int64_t m, int64_t columns,
                       int32_t* centre, int16_t* number) {
  constexpr auto LIMIT = static_cast<double>(splatwizard::SYMBOL_LIMIT), LARGEST_SCALE = 68719476736.0;  // 2^36
  int32_t eighths[COLUMNS], bucket[COLUMNS];
  double ratio[COLUMNS];
  IntVec lane, beyond{};
  for (int l = 0; l < LANES; ++l) lane[l] = l;
  const Vec divisor = all(static_cast<double>(m)), half = all(static_cast<double>(m / 2));
  for (int64_t c = 0; c < columns; c += LANES) {
    const Vec e = floor_of((load(mean + c) * 8.0 + half) / divisor);
    const Vec at = floor_of((e + 4.0) * 0.125);
    const Vec quotient = floor_of(clamped(load(scale + c), 0, LARGEST_SCALE) * 4096.0 / divisor);
    beyond |= ((at >= all(LIMIT)) | (at <= all(-LIMIT))) & (lane < IntVec{} + (columns - c));
    store(ratio + c, quotient);
    store_narrow(bucket + c, buckets_of(quotient));
    store_narrow(eighths + c, __builtin_convertvector(e + 4.0 - at * 8.0, Narrow));
    store_narrow(centre + c, __builtin_convertvector(at, Narrow));
  }
  int64_t any = 0;
  for (int l = 0; l < LANES; ++l) any |= beyond[l];
  for (int64_t c = 0; c < columns; ++c) {
    int32_t level = levels.first[bucket[c]];
    level += levels.threshold[level] < ratio[c];
    number[c] = static_cast<int16_t>(8 * level + eighths[c]);
  }
  if (levels.several)
    for (int64_t c = 0; c < columns; ++c)
      while (levels.threshold[number[c] >> 3] < ratio[c]) number[c] = static_cast<int16_t>(number[c] + 8);
  return any != 0;
}

// Integers of a row as float64; false if one is beyond 2^48.
inline bool take_integers(const int64_t* from, int64_t n, double* to) {
  constexpr int64_t LIMIT = int64_t{1} << 48;
  IntVec wrong{};
  int64_t c = 0;
  for (; c + LANES <= n; c += LANES) {
    const IntVec x = *reinterpret_cast<const IntLoad*>(from + c);
    wrong |= (x <= -LIMIT) | (x >= LIMIT);
    store(to + c, of_integers(x));
  }
  int64_t any = 0;
  for (int l = 0; l < LANES; ++l) any |= wrong[l];
  for (; c < n; ++c) {
    any |= from[c] <= -LIMIT || from[c] >= LIMIT;
    to[c] = static_cast<double>(from[c]);
  }
  for (; c % LANES; ++c) to[c] = 0;
  return any == 0;
}

// Moves the present ones of n numbers to the front; how many there are.
inline int64_t keep_present(const uint8_t* present, int64_t n, int32_t* centre, int16_t* number) {
  int64_t kept = 0;
  for (int64_t i = 0; i < n; ++i) {
    centre[kept] = centre[i];
    number[kept] = number[i];
    kept += present[i];
  }
  return kept;
}

}  // namespace SW_ARCH
