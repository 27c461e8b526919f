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

// A stream that is being decoded, table by table.
struct Decoding {
  const Tables& tables;
  WordReader words;
  EscapeReader escapes;
  const int32_t* centre;
  int32_t* symbols;
  const int32_t* shares = nullptr;  // of the table at hand
  const uint16_t* bucket = nullptr;
  int32_t radius = 0, table = -1, at = 0, end = 0;  // its rows in `order`
  uint16_t order[STREAM];
  int32_t begin[TABLES + 1];

  Decoding(const Tables& all_tables, const Streams& streams, int64_t s, const int32_t* centres, const int16_t* numbers,
           int64_t count, int32_t* found)
      : tables(all_tables),
        words(streams.data + streams.offset[s], streams.table[3 * s + 1]),
        escapes(streams.data + streams.offset[s] + streams.table[3 * s + 1], streams.table[3 * s + 2]),
        centre(centres + s * STREAM),
        symbols(found + s * STREAM) {
    const int64_t left = count - s * STREAM;
    order_by_table(numbers + s * STREAM, left < STREAM ? left : STREAM, order, begin);
    go_on();
  }
  // Takes up the next table that has rows, if all of this one's are decoded.
  void go_on() {
    while (at == end && table + 1 < TABLES) {
      end = begin[++table + 1];
      shares = tables.shares + tables.first[table];
      bucket = tables.bucket + 256 * table;
      radius = tables.radius[table];
    }
  }
  bool done() const { return at == end; }
  int32_t status() const { return !words.used_up() ? WORDS_LEFT : escapes.used_up() ? FINE : ESCAPES_WRONG; }
};

// Decodes the symbol of row number j in the order, with a copy of the words that stays in registers.
inline int32_t decode_symbol(Decoding& d, WordReader& words, int32_t j) {
  const int32_t s = words.entry(d.shares, d.bucket);
  int64_t value = s - d.radius;
  if (__builtin_expect(s > 2 * d.radius, 0)) {
    value = d.escapes.beyond(d.radius);
    if (d.escapes.damaged) return ESCAPES_WRONG;
  }
  value += d.centre[d.order[j]];
  if (value >= SYMBOL_LIMIT || value <= -SYMBOL_LIMIT) return BEYOND_LIMIT;
  d.symbols[d.order[j]] = static_cast<int32_t>(value);
  return FINE;
}

int32_t decode_rest(Decoding& d) {
  for (; !d.done(); d.go_on()) {
    WordReader words = d.words;
    for (; d.at < d.end; ++d.at)
      if (const int32_t found = decode_symbol(d, words, d.at); found != FINE) return found;
    d.words = words;
  }
  return d.status();
}

// Two streams at once: each symbol waits for the one before it, but not for those of the other stream.
int32_t decode_both(Decoding& a, Decoding& b) {
  while (!a.done() && !b.done()) {
    const int32_t n = a.end - a.at < b.end - b.at ? a.end - a.at : b.end - b.at;
    WordReader first = a.words, second = b.words;
    for (int32_t k = 0; k < n; ++k) {
      const int32_t one = decode_symbol(a, first, a.at + k), other = decode_symbol(b, second, b.at + k);
      if (__builtin_expect(one | other, 0)) return one != FINE ? one : other;
    }
    a.words = first;
    b.words = second;
    a.at += n;
    b.at += n;
    a.go_on();
    b.go_on();
  }
  const int32_t found = decode_rest(a);
  return found != FINE ? found : decode_rest(b);
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
  const auto streams_from = [&](int64_t s) { return Decoding(tables, streams, s, centre, number, count, symbols); };
  parallel(streams.count, 1, [&](int64_t begin, int64_t end) {
    for (int64_t s = begin; s + 1 < end; s += 2) {
      Decoding one = streams_from(s), other = streams_from(s + 1);
      raise(status, decode_both(one, other));
    }
    if ((end - begin) % 2) {
      Decoding last = streams_from(end - 1);
      raise(status, decode_rest(last));
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
