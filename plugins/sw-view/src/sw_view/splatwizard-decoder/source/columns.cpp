#include "columns.h"

namespace swz {

namespace {

constexpr int64_t CONSTANT = 0, BINS = 1, MAGNITUDES = 2, DICTIONARY = 3, DIFFERENCES = 16;
constexpr int64_t CHUNK = 1 << 20, MAX_ELEMENTS = 1 << 30, MAX_VALUE = int64_t{1} << 60;

int64_t magnitude(int64_t value) { return value < 0 ? (value == INT64_MIN ? INT64_MAX : -value) : value; }

}  // namespace

Columns::Columns(Bytes data, int64_t wanted_rows, int64_t wanted_width)
    : rows(wanted_rows), width(wanted_width), rest(data), symbols(Bytes{}) {
  const auto version = rest.integer(1);
  const auto found_rows = static_cast<int64_t>(rest.integer(4)), found_width = static_cast<int64_t>(rest.integer(2));
  crc = rest.integer(4);
  if (version != 1)
    refuse("columns of version ", static_cast<int64_t>(version), " are not known: upgrade sw-codecs");
  if (found_rows != rows || found_width != width || rows * width > MAX_ELEMENTS)
    refuse("a matrix of ", grouped(found_rows), " x ", grouped(found_width), ", expected ", grouped(rows), " x ",
           grouped(width));
  plans = Buffer<Plan>(width);
  Buffer<int64_t> sizes(width);
  for (int64_t i = 0; i < width; ++i) {
    Plan& plan = *new (plans.data + i) Plan{};
    read_plan(plan);
    if (plan.kind != CONSTANT) sizes[coded++] = plan.size;
  }
  tables = stored_tables(rest, sizes.data, coded);
  int64_t at = 0;
  for (int64_t i = 0; i < coded; at += sizes[i++]) {
    bool any = false;
    for (int64_t k = 0; k < sizes[i]; ++k) any |= tables[at + k] > 0;
    if (!any) refuse("a count table is empty");
  }
  chunks = rest.take(rest.length());
  classes = Buffer<int32_t>(coded ? rows : 0);
}

void Columns::read_plan(Plan& plan) {
  const auto kind = static_cast<int64_t>(rest.integer(1));
  plan.parameter = static_cast<int64_t>(rest.integer(1));
  plan.kind = kind & ~DIFFERENCES;
  plan.differences = (kind & DIFFERENCES) != 0;
  plan.offset = rest.signed_varint();
  plan.size = static_cast<int64_t>(rest.varint(MAX_TABLE));
  plan.first = plan.differences ? rest.signed_varint() : 0;
  const int64_t gaps = plan.kind == DICTIONARY && plan.size > 0 ? plan.size - 1 : 0;
  plan.dictionary = Buffer<int64_t>(gaps + 1);
  bool in_order = true;
  uint64_t sum = 0;
  for (int64_t i = 0; i < gaps; ++i) {
    const uint64_t gap = rest.varint(4 * uint64_t{MAX_VALUE});
    sum += gap;
    in_order &= gap >= 1 && sum <= 4 * uint64_t{MAX_VALUE};
    plan.dictionary[i + 1] = static_cast<int64_t>(sum);
    if (!in_order) sum = 0;  // whatever follows
  }
  const int64_t limit = plan.kind == BINS ? 63 : plan.kind == MAGNITUDES ? 8 : 0;
  if (plan.kind > DICTIONARY || plan.parameter > limit || (plan.size == 0) != (plan.kind == CONSTANT))
    refuse("unknown column scheme ", kind, "/", plan.parameter, " with ", plan.size, " classes");
  if (magnitude(plan.offset) > 2 * MAX_VALUE || magnitude(plan.first) > MAX_VALUE)
    refuse("a column's offset is out of range");
  if (!in_order) refuse("a column's dictionary is out of order or out of range");
  if (plan.kind == BINS && static_cast<uint64_t>(plan.size) > (8 * uint64_t{MAX_VALUE}) >> plan.parameter)
    refuse("a column's bins leave the 64-bit range");
  if (plan.kind == MAGNITUDES && class_bits(plan.size - 1, static_cast<int>(plan.parameter)) + plan.parameter > 63)
    refuse("a column's classes leave the 64-bit range");
  plan.dictionary[0] = 0;
  for (int64_t i = 0; i <= gaps; ++i) plan.dictionary[i] += plan.offset;
}

void Columns::take_classes(const Plan& plan) {
  const Model model(tables.data + at_table, plan.size);
  at_table += plan.size;
  --coded;
  for (int64_t start = 0; start < rows; start += CHUNK) {
    const int64_t count = rows - start < CHUNK ? rows - start : CHUNK;
    if (!begun || symbols.count + count > CHUNK) {
      if (begun) symbols.check(chunk_crc);
      const auto length = static_cast<int64_t>(chunks.integer(4));
      chunk_crc = chunks.integer(4);
      symbols = Symbols(chunks.take(length));
      begun = true;
    }
    symbols.take(model, classes.data + start, count);
  }
  if (begun && coded == 0) symbols.check(chunk_crc);
}

void Columns::join(const Plan& plan, int64_t* values) {
  const auto parameter = static_cast<int>(plan.parameter);
  if (plan.kind == DICTIONARY) {
    for (int64_t i = 0; i < rows; ++i) values[i] = plan.dictionary[classes[i]];
  } else if (plan.kind == BINS) {
    RawBits raw(rest, rows, parameter);
    for (int64_t i = 0; i < rows; ++i) {
      const uint64_t low = parameter ? raw.next(parameter) : 0;
      values[i] = static_cast<int64_t>((static_cast<uint64_t>(classes[i]) << parameter | low) +
                                       static_cast<uint64_t>(plan.offset));
    }
    raw.finish();
  } else {
    bool occurs[64] = {};
    for (int64_t i = 0; i < rows; ++i) {
      values[i] = static_cast<int64_t>(class_floor(classes[i], parameter));
      occurs[class_bits(classes[i], parameter)] = true;
    }
    int64_t number[64] = {};
    for (int64_t i = 0; i < rows; ++i) ++number[class_bits(classes[i], parameter)];
    for (int bits = 1; bits < 64; ++bits) {
      if (!occurs[bits]) continue;
      RawBits raw(rest, number[bits], bits);
      for (int64_t i = 0; i < rows; ++i)
        if (class_bits(classes[i], parameter) == bits) values[i] |= static_cast<int64_t>(raw.next(bits));
      raw.finish();
    }
    for (int64_t i = 0; i < rows; ++i)
      values[i] = static_cast<int64_t>(static_cast<uint64_t>(unzigzag(static_cast<uint64_t>(values[i]))) +
                                       static_cast<uint64_t>(plan.offset));
  }
}

void Columns::next(int64_t* values) {
  const Plan& plan = plans[column++];
  if (plan.kind == CONSTANT) {
    for (int64_t i = 0; i < rows; ++i) values[i] = plan.offset;
  } else {
    take_classes(plan);
    join(plan, values);
  }
  auto above = static_cast<uint64_t>(plan.first);
  bool beyond = false;
  for (int64_t i = 0; i < rows; ++i) {
    if (plan.differences) {
      above += static_cast<uint64_t>(values[i]);
      values[i] = static_cast<int64_t>(above);
    }
    beyond |= magnitude(values[i]) > MAX_VALUE;
  }
  if (beyond) refuse("a value is beyond 2^60");
  found_crc = crc32(values, 8 * rows, found_crc);
}

void Columns::finish() {
  chunks.finish();
  rest.finish();
  if (found_crc != crc) refuse("the decoded matrix does not match its CRC-32");
}

}  // namespace swz
