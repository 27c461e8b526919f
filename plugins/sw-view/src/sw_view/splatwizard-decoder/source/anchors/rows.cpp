#include "rows.h"

#include <mixtures.h>
#include <range_coded.h>

#include "chunks.h"
#include "escapes.h"

namespace swz {

namespace {

using splatwizard::STREAM;
using splatwizard::SYMBOL_LIMIT;

constexpr splatwizard::Parallel ALONE;
constexpr int TABLES = 512;
constexpr int64_t WIDTHS[] = {4, 6, 8, 12, 16, 24, 32, 48, 64, 128, 256};

// Numbers of a block that are present, and where those of each row begin.
struct Present {
  Buffer<int64_t> start;
  int64_t count = 0;

  explicit Present(const Block& block) : start(block.rows) {
    for (int64_t row = 0; row < block.rows; ++row) {
      start[row] = count;
      if (block.present == nullptr) {
        count += block.columns;
        continue;
      }
      for (int64_t c = 0; c < block.columns; ++c) count += block.present[row * block.columns + c];
    }
  }
};

void put(const Block& block, const int64_t* start, const int32_t* symbols, const Destination& to) {
  Buffer<int64_t> integers(block.rows * block.columns);
  arch_native::put_values({symbols, block.present, start, to.step, block.rows, block.columns, to.values, to.stride,
                           integers.data}, ALONE);
  if (to.integers == nullptr) return;
  for (int64_t row = 0; row < block.rows; ++row)
    for (int64_t c = 0; c < block.columns; ++c)
      to.integers[row * to.integers_stride + c] = integers[row * block.columns + c] * to.multiplier[row];
}

}  // namespace

void refuse_damage(int32_t status) {
  static constexpr const char* DAMAGE[] = {"", "coded words are damaged, too few or too many",
                                           "an escape code is damaged, or their number is not that of the escaped symbols",
                                           "a symbol is too large"};
  if (status) refuse(DAMAGE[status], ": damaged data or a wrong context");
}

StreamTable::StreamTable(Bytes& from, int64_t count, bool has_crc) : sizes(3 * count), offsets(count) {
  if (count * (has_crc ? 6 : 2) > from.left)
    refuse(grouped(from.left), " bytes cannot hold ", grouped(count), " streams: the data is truncated");
  int64_t total = 0;
  bool whole = true;
  for (int64_t s = 0; s < count; ++s) {
    sizes[3 * s] = has_crc ? static_cast<int64_t>(from.integer(4)) : 0;
    sizes[3 * s + 1] = from.length();
    sizes[3 * s + 2] = from.length();
    offsets[s] = total;
    total += sizes[3 * s + 1] + sizes[3 * s + 2];
    whole &= sizes[3 * s + 1] % 4 == 0;
  }
  if (total != from.left || !whole)
    refuse("the streams are said to have ", grouped(total), " bytes in whole words, ", grouped(from.left), " are there");
  data = from.take(from.left);
}

void RowDecoder::streams(Bytes data, const int32_t* centre, const int16_t* number, int64_t count,
                         int32_t* symbols) const {
  const auto version = static_cast<int64_t>(data.integer(2)), crc = static_cast<int64_t>(data.integer(4));
  tables.check(version == 2 ? tables.version : version, crc);
  if (version == 1) return version_1(data, centre, number, count, symbols);
  const StreamTable table(data, (count + STREAM - 1) / STREAM, true);
  refuse_damage(arch_native::decode_streams(
      tables.gaussian.tables(), {table.data.data, table.sizes.data, table.offsets.data, table.offsets.size}, centre,
      number, count, symbols, ALONE));
  for (int64_t s = 0, left = count; s < table.offsets.size; ++s, left -= STREAM)
    if (crc32(symbols + s * STREAM, 4 * (left < STREAM ? left : STREAM)) != table.sizes[3 * s]) refuse(WRONG_CONTEXT);
}

void RowDecoder::version_1(Bytes data, const int32_t* centre, const int16_t* number, int64_t count,
                           int32_t* symbols) const {
  const int32_t* radii = tables.gaussian.radius.data;
  for (; count > 0; count -= CHUNK, centre += CHUNK, number += CHUNK, symbols += CHUNK) {
    const int64_t n = count < CHUNK ? count : CHUNK;
    const ChunkHead head(data, n);
    Bytes payload = data.take(head.length);
    const Bytes words = whole_words(payload.take(payload.length()));
    arch_native::RangeReader reader(words.data, words.left);
    int64_t state[4];
    const splatwizard::RangeSession session{words.data, words.left, state};
    session.store(reader);
    if (arch_native::range_entries(session, tables.gaussian.tables(), number, n, symbols)) refuse(DAMAGED_WORDS);
    const Buffer<int64_t> escaped = escaped_rows(symbols, number, n, radii);
    Escapes codes(payload, escaped.size);
    int64_t least = INT64_MAX, most = INT64_MIN;
    const auto settle = [&](int64_t at, int64_t offset) {
      const int64_t value = offset + centre[at];
      least = value < least ? value : least;
      most = value > most ? value : most;
      symbols[at] = static_cast<int32_t>(value);
    };
    for (int64_t i = 0; i < n; ++i)
      if (symbols[i] <= 2 * radii[number[i]]) settle(i, symbols[i] - radii[number[i]]);
    for (int64_t i = 0; i < escaped.size; ++i) settle(escaped[i], codes.beyond(radii[number[escaped[i]]]));
    codes.finish();
    if (least != head.low || most != head.high || crc32(symbols, 4 * n) != head.crc) refuse(WRONG_CONTEXT);
  }
  data.finish();
}

void RowDecoder::gaussians(Bytes data, const Block& block, Integers mean, Integers scale, const Destination& to) {
  const Present present(block);
  Buffer<int32_t> centre(present.count), symbols(present.count);
  Buffer<int16_t> number(present.count);
  const int32_t status = arch_native::lattice(
      {mean.data, scale.data, to.multiplier, mean.stride, scale.stride, 1, block.present, present.start.data, block.rows,
       block.columns, tables.thresholds, centre.data, number.data}, ALONE);
  for (int64_t i = 0; status && i < present.count; ++i)  // what is not present may be beyond
    if (centre[i] >= SYMBOL_LIMIT || centre[i] <= -SYMBOL_LIMIT) refuse("a mean is beyond 2^30 steps");
  streams(data, centre.data, number.data, present.count, symbols.data);
  put(block, present.start.data, symbols.data, to);
}

void RowDecoder::sum_tables() {
  const TableFamily& of = tables.gaussian;
  below = Buffer<double>(of.counts.size);
  escape = Buffer<double>(TABLES);
  first_below = Buffer<int32_t>(TABLES);
  for (int64_t t = 0; t < TABLES; ++t) {
    const int64_t first = of.first_count[t], entries = 2 * of.radius[t] + 1;
    double sum = 0;
    for (int64_t i = 0; i < entries; ++i) {
      below[first + i] = sum;
      sum += of.counts[first + i] + 1.0;
    }
    below[first + entries] = sum;
    escape[t] = of.counts[first + entries] + 1.0;
    first_below[t] = static_cast<int32_t>(first);
  }
}

void RowDecoder::mixtures(Bytes data, const Block& block, const Mixture& of, const Destination& to) {
  if (below.data == nullptr) sum_tables();
  const int64_t n = block.rows * block.columns;
  Buffer<int32_t> centre(n), width(n), order(n), shift(2 * n), weight(n), entries(n);
  Buffer<int16_t> number(2 * n);
  int64_t multipliers[128];
  for (int i = 0; i < 128; ++i) multipliers[i] = tables.multipliers[i];
  if (arch_native::mixture_rows(
          {{of.mean[0].data, of.mean[1].data}, {of.scale[0].data, of.scale[1].data}, of.logit.data, to.multiplier,
           {of.mean[0].stride, of.scale[0].stride, of.mean[1].stride, of.scale[1].stride, of.logit.stride, 1},
           block.rows, block.columns, multipliers, tables.thresholds, tables.gaussian.radius.data, WIDTHS,
           sizeof(WIDTHS) / sizeof(*WIDTHS), centre.data, width.data, order.data, shift.data, weight.data, number.data},
          ALONE))
    refuse("a mean is beyond 2^30 steps");
  if (n == 0) return data.finish();
  const auto version = static_cast<int64_t>(data.integer(2));
  tables.check(version, static_cast<int64_t>(data.integer(4)));
  const uint64_t crc = data.integer(4);
  const Bytes words = whole_words(data.take(data.length()));
  if (arch_native::decode_mixtures({below.data, escape.data, first_below.data, tables.gaussian.radius.data, order.data,
                                    width.data, shift.data, number.data, weight.data, n},
                                   words.data, words.left, entries.data))
    refuse("coded words are damaged");
  int64_t escaped = 0;
  for (int64_t i = 0; i < n; ++i) escaped += entries[i] > 2 * width[i];
  Escapes codes(data, escaped);
  bool beyond = false;
  for (int64_t i = 0; i < n; ++i) {
    const int64_t at = order[i];
    int64_t value = entries[at] - width[at];
    if (value > width[at]) value = codes.beyond(width[at]);
    value += centre[at];
    beyond |= value >= SYMBOL_LIMIT || value <= -SYMBOL_LIMIT;
    entries[at] = static_cast<int32_t>(value);
  }
  codes.finish();
  if (beyond) refuse("a symbol is beyond 2^30: damaged data or a wrong context");
  if (crc32(entries.data, 4 * n) != crc) refuse(WRONG_CONTEXT);
  put(block, nullptr, entries.data, to);
}

void bernoulli(Bytes data, int64_t count, int32_t* bits) {
  const auto ones = static_cast<int64_t>(data.varint(static_cast<uint64_t>(count)));
  const double share = count ? static_cast<double>(ones) / static_cast<double>(count) : 0.5;
  const auto zeros = static_cast<uint32_t>((1 - share) * ((1 << 24) - 2)) + 1;
  read_chunks(data, count, 1, bits, [&](Bytes payload, int32_t* to, int64_t wanted) {
    const Bytes words = whole_words(payload);
    if (arch_native::decode_bits(words.data, words.left, zeros, wanted, to)) refuse("the coded words are damaged");
  });
  int64_t found = 0;
  for (int64_t i = 0; i < count; ++i) found += bits[i];
  if (found != ones) refuse("a mask with ", grouped(found), " ones, ", grouped(ones), " were announced");
}

}  // namespace swz
