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
