// Symbols under tables of counts: streams of 2^16, each coded table by table, and what selects the tables.
#include <atomic>
#include <cstring>

#include "rans.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

constexpr int TABLES = 512;

void raise(std::atomic<int32_t>& status, int32_t found) {
  int32_t fine = FINE;
  if (found != FINE) status.compare_exchange_strong(fine, found);
}

// Rows of a stream ordered by table, in their order within each; where the rows of each table begin.
void order_by_table(const int16_t* number, int64_t n, uint16_t* order, int32_t* begin) {
  std::memset(begin, 0, sizeof(int32_t) * (TABLES + 1));
  for (int64_t i = 0; i < n; ++i) ++begin[number[i] + 1];
  for (int t = 0; t < TABLES; ++t) begin[t + 1] += begin[t];
  int32_t next[TABLES];
  std::memcpy(next, begin, sizeof(next));
  for (int64_t i = 0; i < n; ++i) order[next[number[i]]++] = static_cast<uint16_t>(i);
}

int32_t decode_one(const Tables& tables, const uint8_t* data, const int64_t* sizes, const int32_t* centre,
                   const int16_t* number, int64_t n, int32_t* symbols, const Crc& crc) {
  uint16_t order[STREAM];
  int32_t begin[TABLES + 1];
  order_by_table(number, n, order, begin);
  WordReader words(data, sizes[1]);
  EscapeReader escapes(data + sizes[1], sizes[2]);
  for (int t = 0; t < TABLES; ++t) {
    if (begin[t] == begin[t + 1]) continue;
    const int32_t* shares = tables.shares + tables.first[t];
    const uint16_t* bucket = tables.bucket + 256 * t;
    const int32_t radius = tables.radius[t];
    for (int32_t j = begin[t]; j < begin[t + 1]; ++j) {
      const int32_t s = words.entry(shares, bucket);
      int64_t value = s - radius;
      if (__builtin_expect(s > 2 * radius, 0)) {
        value = escapes.beyond(radius);
        if (escapes.damaged) return ESCAPES_WRONG;
      }
      value += centre[order[j]];
      if (value >= SYMBOL_LIMIT || value <= -SYMBOL_LIMIT) return BEYOND_LIMIT;
      symbols[order[j]] = static_cast<int32_t>(value);
    }
  }
  if (!words.used_up()) return WORDS_LEFT;
  if (!escapes.used_up()) return ESCAPES_WRONG;
  return crc.of(symbols, n) == sizes[0] ? FINE : CRC_WRONG;
}

void encode_one(const Tables& tables, uint8_t* data, int64_t* sizes, const int32_t* centre, const int16_t* number,
                int64_t n, const int32_t* symbols, const Crc& crc) {
  uint16_t order[STREAM];
  int32_t begin[TABLES + 1];
  order_by_table(number, n, order, begin);
  WordWriter words(data);
  for (int t = TABLES - 1; t >= 0; --t) {
    const int32_t* shares = tables.shares + tables.first[t];
    const int64_t radius = tables.radius[t];
    for (int32_t j = begin[t + 1] - 1; j >= begin[t]; --j) {
      const int64_t offset = int64_t{symbols[order[j]]} - centre[order[j]];
      const bool inside = offset <= radius && offset >= -radius;
      words.put(shares, static_cast<int32_t>(inside ? offset + radius : 2 * radius + 1));
    }
  }
  words.finish();
  EscapeWriter escapes(data + words.bytes);
  for (int t = 0; t < TABLES; ++t) {
    const int64_t radius = tables.radius[t];
    for (int32_t j = begin[t]; j < begin[t + 1]; ++j) {
      const int64_t offset = int64_t{symbols[order[j]]} - centre[order[j]];
      if (offset > radius || offset < -radius) escapes.beyond(offset, radius);
    }
  }
  sizes[0] = crc.of(symbols, n);
  sizes[1] = words.bytes;
  sizes[2] = escapes.bytes();
}

}  // namespace

int32_t decode_streams(const Tables& tables, const Streams& streams, const int32_t* centre, const int16_t* number,
                       int64_t count, int32_t* symbols, const Parallel& parallel) {
  static const Crc crc;
  std::atomic<int32_t> status{FINE};
  parallel(streams.count, 1, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) {
      const int64_t at = s * STREAM, n = count - at < STREAM ? count - at : STREAM;
      raise(status, decode_one(tables, streams.data + streams.offset[s], streams.table + 3 * s, centre + at,
                               number + at, n, symbols + at, crc));
    }
  });
  return status;
}

int32_t encode_streams(const Tables& tables, const Sinks& sinks, const int32_t* centre, const int16_t* number,
                       int64_t count, const int32_t* symbols, const Parallel& parallel) {
  static const Crc crc;
  parallel(sinks.count, 1, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) {
      const int64_t at = s * STREAM, n = count - at < STREAM ? count - at : STREAM;
      encode_one(tables, sinks.data + sinks.offset[s], sinks.table + 3 * s, centre + at, number + at, n, symbols + at,
                 crc);
    }
  });
  return FINE;
}

namespace {

constexpr int FIRST_BITS = 4 * 34;

// Number of thresholds below the smallest number of each quarter of an octave.
void first_levels(const int64_t* thresholds, int32_t* first) {
  for (int i = 0; i < FIRST_BITS; ++i) {
    const uint64_t bits = (uint64_t{1023 * 4} + static_cast<uint64_t>(i)) << 50;
    double low;
    std::memcpy(&low, &bits, 8);
    int level = 0;
    while (i > 0 && level < 63 && static_cast<double>(thresholds[level]) < low) ++level;
    first[i] = level;
  }
}

}  // namespace

// Quotients are taken in float64: with a dividend below 2^53 and a divisor m, floor of the rounded quotient q is exact
// as long as q 2^-53 < 1 / m; what is beyond is refused, or far above the last threshold.
int32_t lattice(const LatticeArgs& a, const Parallel& parallel) {
  int32_t first[FIRST_BITS];
  first_levels(a.thresholds, first);
  double thresholds[64];
  for (int i = 0; i < 63; ++i) thresholds[i] = static_cast<double>(a.thresholds[i]);
  constexpr int64_t LIMIT = int64_t{1} << 48, LARGEST_SCALE = int64_t{1} << 36;
  std::atomic<int32_t> status{FINE};
  parallel(a.rows, 1024, [&](int64_t begin, int64_t end) {
    int32_t found = FINE;
    for (int64_t row = begin; row < end; ++row) {
      const int64_t *mean = a.mean + row * a.mean_stride, *scale = a.scale + row * a.scale_stride;
      const uint8_t* present = a.present == nullptr ? nullptr : a.present + row * a.columns;
      const int64_t m = a.multiplier[row * a.multiplier_stride];
      if (m < 64 || m > 16384) {
        found = PARAMETER_WRONG;
        continue;
      }
      const auto divisor = static_cast<double>(m);
      int64_t at = a.present == nullptr ? row * a.columns : a.start[row];
      for (int64_t c = 0; c < a.columns; ++c) {
        if (present != nullptr && !present[c]) continue;
        int64_t width = scale[c];
        if (mean[c] <= -LIMIT || mean[c] >= LIMIT || width <= -LIMIT || width >= LIMIT) found = PARAMETER_WRONG;
        width = width < 0 ? 0 : width > LARGEST_SCALE ? LARGEST_SCALE : width;
        const double quotient = static_cast<double>(8 * mean[c] + m / 2) / divisor;
        auto eighths = static_cast<int64_t>(quotient);
        eighths -= static_cast<double>(eighths) > quotient;
        const int64_t centre = (eighths + 4) >> 3;
        if (centre <= -SYMBOL_LIMIT || centre >= SYMBOL_LIMIT) found = found == FINE ? BEYOND_LIMIT : found;
        const auto ratio = static_cast<double>(static_cast<int64_t>(static_cast<double>(width << 12) / divisor));
        uint64_t bits;
        std::memcpy(&bits, &ratio, 8);
        int64_t index = static_cast<int64_t>(bits >> 50) - 1023 * 4;
        index = index < 0 ? 0 : index >= FIRST_BITS ? FIRST_BITS - 1 : index;
        int32_t level = first[index];
        while (level < 63 && thresholds[level] < ratio) ++level;
        a.centre[at] = static_cast<int32_t>(centre);
        a.number[at++] = static_cast<int16_t>(level * 8 + eighths + 4 - 8 * centre);
      }
    }
    raise(status, found);
  });
  return status;
}

}  // namespace SW_ARCH
