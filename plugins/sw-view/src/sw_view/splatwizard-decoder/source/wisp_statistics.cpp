// Context `none` of wisp: a Gaussian for each level and column.
#include <new>

#include "wisp.h"

namespace swz {

namespace {

struct Statistics final : Context {
  uint8_t row[16];
  int64_t multipliers[NUMBERS];
  Buffer<int64_t> means, scales;  // [rows, 22]

  void predict(int block, Rows rows, const Splats& splats, Prediction& to) override {
    const Span columns = BLOCKS[block];
    for (int64_t i = 0, at = 0; i < rows.count; ++i) {
      const int64_t from = NUMBERS * row[splats.levels[rows[i]] - LOWEST_LEVEL];
      for (int64_t c = columns.first; c < columns.end; ++c, ++at) {
        to.mean[at] = means[from + c];
        to.scale[at] = scales[from + c];
        to.multiplier[at] = static_cast<int32_t>(multipliers[c]);
      }
    }
  }
  void tie(int, int, int64_t, const Splats&, int64_t*, int64_t*) const override {}
  void learn(Span, Rows, const Splats&) override {}
  void refine(Rows, const int64_t*, const Splats&) override {}
};

}  // namespace

Context& read_statistics(Bytes& from) {
  auto& found = *new Statistics;
  found.base_parts = found.later_parts = 1;
  const auto rows = static_cast<int64_t>(from.integer(1));
  std::memcpy(found.row, from.take(sizeof(found.row)).data, sizeof(found.row));
  for (auto& each : found.multipliers) each = static_cast<int64_t>(from.integer(2));
  found.means = Buffer<int64_t>(NUMBERS * rows);
  found.scales = Buffer<int64_t>(NUMBERS * rows);
  Bytes means = from.take(2 * NUMBERS * rows), scales = from.take(NUMBERS * rows);
  bool there = true, fits = true;
  for (int64_t i = 0; i < NUMBERS * rows; ++i) {
    found.means[i] = 16 * static_cast<int16_t>(means.integer(2));
    const auto table = static_cast<int64_t>(scales.integer(1));
    there &= table < 64;
    found.scales[i] = UNIT * table;
  }
  for (const uint8_t each : found.row) there &= each < rows;
  for (const int64_t each : found.multipliers) fits &= each >= 64 && each <= 2 * UNIT;
  if (!there) refuse("statistics of a level are not there");
  if (!fits) refuse("a step multiplier leaves 64..8192");
  return found;
}

}  // namespace swz
