#include "symbols.h"

namespace swz {

Model::Model(const int64_t* counts, int64_t size) : share(size + 1) {
  double total = 0;
  int64_t positive = 0;
  for (int64_t i = 0; i < size; ++i) {
    total += static_cast<double>(counts[i]);
    if (counts[i] > 0) {
      only = i;
      ++positive;
    }
  }
  if (positive == 0) refuse("a count table is empty");
  if (positive == 1) return;
  only = -1;
  const double factor = static_cast<double>(arch_native::TOP - static_cast<uint64_t>(size)) / total;
  double before = 0;
  for (int64_t i = 0; i < size; ++i) {
    share[i] = static_cast<uint32_t>(before * factor) + static_cast<uint32_t>(i);
    before += static_cast<double>(counts[i]);
  }
  share[size] = arch_native::TOP;
  int entry = 0;
  for (uint32_t i = 0; i < 1024; ++i) {
    while (share[entry + 1] <= i << (arch_native::BITS - 10)) ++entry;
    bucket[i] = static_cast<uint16_t>(entry);
  }
}

namespace {

constexpr int MANTISSA = 3, MAX_CODE = 239, MAX_META = 2 * MAX_CODE + 1;

// The counts of the differences of count codes; how many there are.
int64_t meta_counts(Bytes& from, int64_t* counts) {
  const auto count = static_cast<int64_t>(from.varint(2 * MAX_META + 1));
  int64_t length = 0;
  bool any = false, beyond = false;
  const auto put = [&](int64_t at) {
    const auto code = static_cast<int64_t>(from.integer(1));
    any |= code != 0;
    beyond |= code > MAX_CODE;
    counts[at] = beyond ? 0 : static_cast<int64_t>(class_floor(code, MANTISSA));
    length = at + 1;
  };
  if (count % 2 == 0) {
    if (count / 2 > from.left) from.take(count / 2);
    for (int64_t i = 0; i < count / 2; ++i) put(i);
  } else {
    for (int64_t i = 0; i < count / 2; ++i) {
      const int64_t place = length + static_cast<int64_t>(from.varint(MAX_META));
      if (place >= MAX_META) refuse("the table of tables is too long");
      for (int64_t unused = length; unused < place; ++unused) counts[unused] = 0;
      put(place);
    }
  }
  if (!any || beyond) refuse("the table of tables is empty or out of range");
  return length;
}

}  // namespace

Buffer<int64_t> stored_tables(Bytes& from, const int64_t* sizes, int64_t tables) {
  int64_t total = 0;
  for (int64_t i = 0; i < tables; ++i) total += sizes[i];
  Buffer<int64_t> found(total);
  if (total == 0) return found;
  int64_t meta[MAX_META];
  const int64_t length = meta_counts(from, meta);
  Symbols coded(from.take(from.length()));
  Buffer<int32_t> differences(total);
  coded.take(Model(meta, length), differences.data, total);
  coded.check(from.integer(4));
  int64_t at = 0;
  for (int64_t table = 0; table < tables; ++table) {
    int64_t code = 0;
    for (int64_t i = 0; i < sizes[table]; ++i, ++at) {
      code += unzigzag(static_cast<uint64_t>(differences[at]));
      if (code < 0 || code > MAX_CODE) refuse("a stored count is out of range");
      found[at] = static_cast<int64_t>(class_floor(code, MANTISSA));
    }
  }
  return found;
}

}  // namespace swz
