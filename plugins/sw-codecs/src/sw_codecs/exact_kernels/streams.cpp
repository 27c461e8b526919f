// Symbols under tables of counts: streams of 2^16, each coded table by table, and what selects the tables.
#include <atomic>
#include <cstring>

#include "rans.h"
#include "vectors.h"

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
                   const int16_t* number, int64_t n, int32_t* symbols) {
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
  return escapes.used_up() ? FINE : ESCAPES_WRONG;
}

void encode_one(const Tables& tables, uint8_t* data, int64_t* sizes, const int32_t* centre, const int16_t* number,
                int64_t n, const int32_t* symbols) {
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
  sizes[1] = words.bytes;
  sizes[2] = escapes.bytes();
}

}  // namespace

int32_t decode_streams(const Tables& tables, const Streams& streams, const int32_t* centre, const int16_t* number,
                       int64_t count, int32_t* symbols, const Parallel& parallel) {
  std::atomic<int32_t> status{FINE};
  parallel(streams.count, 1, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) {
      const int64_t at = s * STREAM, n = count - at < STREAM ? count - at : STREAM;
      raise(status, decode_one(tables, streams.data + streams.offset[s], streams.table + 3 * s, centre + at,
                               number + at, n, symbols + at));
    }
  });
  return status;
}

int32_t encode_streams(const Tables& tables, const Sinks& sinks, const int32_t* centre, const int16_t* number,
                       int64_t count, const int32_t* symbols, const Parallel& parallel) {
  parallel(sinks.count, 1, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s < end; ++s) {
      const int64_t at = s * STREAM, n = count - at < STREAM ? count - at : STREAM;
      encode_one(tables, sinks.data + sinks.offset[s], sinks.table + 3 * s, centre + at, number + at, n, symbols + at);
    }
  });
  return FINE;
}

namespace {

constexpr int BUCKETS = 16 * 34;  // sixteen of each octave below 2^34, which is above the last threshold
constexpr int COLUMNS = 64;       // of a row, worked out together

struct Levels {
  int32_t first[BUCKETS];  // number of thresholds below the smallest number of a bucket
  double threshold[64];

  explicit Levels(const int64_t* thresholds) {
    for (int i = 0; i < 63; ++i) threshold[i] = static_cast<double>(thresholds[i]);
    threshold[63] = 1e300;
    for (int i = 0; i < BUCKETS; ++i) {
      const uint64_t bits = (uint64_t{1023 * 16} + static_cast<uint64_t>(i)) << 48;
      double low;
      std::memcpy(&low, &bits, 8);
      first[i] = 0;
      while (i > 0 && threshold[first[i]] < low) ++first[i];
    }
  }
  int32_t of(double ratio) const {
    uint64_t bits;
    std::memcpy(&bits, &ratio, 8);
    int64_t i = static_cast<int64_t>(bits >> 48) - 1023 * 16;
    i = i < 0 ? 0 : i >= BUCKETS ? BUCKETS - 1 : i;
    int32_t level = first[i];
    level += threshold[level] < ratio;  // few buckets have more than one threshold
    while (threshold[level] < ratio) ++level;
    return level;
  }
};

// Integer parts and table numbers of some columns of a row; what is wrong with them.
//
// Quotients are taken in float64: with a dividend below 2^53 and a divisor m, floor of the rounded quotient q is exact
// as long as q 2^-53 < 1 / m; what is beyond is refused, or far above the last threshold.
int32_t columns_of(const Levels& levels, const int64_t* mean, const int64_t* scale, int64_t m, int64_t columns,
                   int32_t* centre, int16_t* number) {
  constexpr int64_t LIMIT = int64_t{1} << 48, LARGEST_SCALE = int64_t{1} << 36;
  double middle[COLUMNS], eighths[COLUMNS], ratio[COLUMNS];
  IntVec wrong{}, beyond{};
  const Vec divisor = all(static_cast<double>(m)), half = all(static_cast<double>(m / 2));
  for (int64_t c = 0; c < columns; c += LANES) {
    IntVec means{}, widths{};
    if (c + LANES <= columns) {
      means = *reinterpret_cast<const IntLoad*>(mean + c);
      widths = *reinterpret_cast<const IntLoad*>(scale + c);
    } else {
      for (int64_t l = 0; c + l < columns; ++l) {
        means[l] = mean[c + l];
        widths[l] = scale[c + l];
      }
    }
    wrong |= (means <= -LIMIT) | (means >= LIMIT) | (widths <= -LIMIT) | (widths >= LIMIT);
    widths = widths < 0 ? IntVec{} : widths;
    widths = widths > LARGEST_SCALE ? IntVec{} + LARGEST_SCALE : widths;
    const Vec e = floor_of((of_integers(means) * 8.0 + half) / divisor);
    const Vec at = floor_of((e + 4.0) * 0.125);
    beyond |= (at >= all(static_cast<double>(SYMBOL_LIMIT))) | (at <= all(-static_cast<double>(SYMBOL_LIMIT)));
    store(eighths + c, e + 4.0 - at * 8.0);
    store(middle + c, at);
    store(ratio + c, floor_of(of_integers(widths) * 4096.0 / divisor));
  }
  int64_t any_wrong = 0, any_beyond = 0;
  for (int l = 0; l < LANES; ++l) {
    any_wrong |= wrong[l];
    any_beyond |= beyond[l];
  }
  if (any_wrong) return PARAMETER_WRONG;
  if (any_beyond) return BEYOND_LIMIT;
  int32_t level[COLUMNS];
  for (int64_t c = 0; c < columns; ++c) level[c] = levels.of(ratio[c]);
  for (int64_t c = 0; c < columns; ++c) centre[c] = static_cast<int32_t>(middle[c]);
  for (int64_t c = 0; c < columns; ++c)
    number[c] = static_cast<int16_t>(8 * level[c] + static_cast<int32_t>(eighths[c]));
  return FINE;
}

}  // namespace

int32_t lattice(const LatticeArgs& a, const Parallel& parallel) {
  const Levels levels(a.thresholds);
  std::atomic<int32_t> status{FINE};
  parallel(a.rows, 1024, [&](int64_t begin, int64_t end) {
    int32_t centre[COLUMNS], found = FINE;
    int16_t number[COLUMNS];
    for (int64_t row = begin; row < end; ++row) {
      const int64_t m = a.multiplier[row * a.multiplier_stride];
      if (m < 64 || m > 16384) {
        found = PARAMETER_WRONG;
        continue;
      }
      const uint8_t* present = a.present == nullptr ? nullptr : a.present + row * a.columns;
      int64_t at = present == nullptr ? row * a.columns : a.start[row];
      for (int64_t c = 0; c < a.columns; c += COLUMNS) {
        const int64_t n = a.columns - c < COLUMNS ? a.columns - c : COLUMNS;
        const int32_t now = columns_of(levels, a.mean + row * a.mean_stride + c, a.scale + row * a.scale_stride + c, m,
                                       n, centre, number);
        if (now != FINE) {
          found = now;
          break;
        }
        for (int64_t i = 0; i < n; ++i) {
          if (present != nullptr && !present[c + i]) continue;
          a.centre[at] = centre[i];
          a.number[at++] = number[i];
        }
      }
    }
    raise(status, found);
  });
  return status;
}

void put_values(const PutArgs& a, const Parallel& parallel) {
  parallel(a.rows, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const uint8_t* present = a.present == nullptr ? nullptr : a.present + row * a.columns;
      const int32_t* from = a.symbols + (present == nullptr ? row * a.columns : a.start[row]);
      float* values = a.values + row * a.stride;
      int64_t* integers = a.integers + row * a.columns;
      const double step = a.step[row];
      for (int64_t c = 0; c < a.columns; ++c) {
        const int32_t symbol = present == nullptr || present[c] ? *from++ : 0;
        integers[c] = symbol;
        values[c] = static_cast<float>(static_cast<double>(symbol) * step);
      }
    }
  });
}

}  // namespace SW_ARCH
