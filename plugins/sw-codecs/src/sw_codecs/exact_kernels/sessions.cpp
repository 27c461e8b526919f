// Symbols of several models from one stream of range-coded words (docs/bitstream.md).
#include "range_coded.h"
#include "ranges.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

// Calls symbol(coded, i) for i < count while it says that all is well, and keeps where the stream then is.
template <class Symbol>
int32_t go_on(const RangeSession& session, int64_t count, const Symbol& symbol) {
  RangeReader coded(session.words, session.bytes);
  session.load(coded);
  for (int64_t i = 0; i < count; ++i)
    if (!symbol(coded, i)) return WORDS_LEFT;
  session.store(coded);
  return FINE;
}

}  // namespace

int32_t range_bits(const RangeSession& session, const int32_t* zeros, int64_t count, bool* bits) {
  return go_on(session, count, [&](RangeReader& coded, int64_t i) {
    const int one = coded.bit(static_cast<uint64_t>(zeros[i]));
    bits[i] = one > 0;
    return one >= 0;
  });
}

int32_t range_entries(const RangeSession& session, const Tables& tables, const int16_t* number, int64_t count,
                      int32_t* entries) {
  Scratch<int64_t> start(512 + 1), order(count);  // places of the symbols of each table, in their own order
  std::memset(start.data, 0, sizeof(int64_t) * 513);
  for (int64_t i = 0; i < count; ++i) ++start[number[i] + 1];
  for (int t = 0; t < 512; ++t) start[t + 1] += start[t];
  for (int64_t i = 0; i < count; ++i) order[start[number[i]]++] = i;
  return go_on(session, count, [&](RangeReader& coded, int64_t i) {
    const int16_t t = number[order[i]];
    const int32_t* shares = tables.shares + tables.first[t];
    const uint64_t q = coded.quantile();
    if (q >= TOP) return false;
    int32_t entry = tables.bucket[256 * t + static_cast<int64_t>(q >> (BITS - 8))];
    while (static_cast<uint64_t>(shares[entry + 1]) <= q) ++entry;
    entries[order[i]] = entry;
    coded.take(static_cast<uint64_t>(shares[entry]), static_cast<uint64_t>(shares[entry + 1]));
    return true;
  });
}

int32_t range_choices(const RangeSession& session, const double* counts, int64_t count, int32_t* entries) {
  return go_on(session, count, [&](RangeReader& coded, int64_t i) {
    const double *n = counts + 3 * i, factor = static_cast<double>(TOP - 3) / (n[0] + n[1] + n[2]);
    const uint64_t share[4] = {0, static_cast<uint64_t>(n[0] * factor) + 1,
                               static_cast<uint64_t>((n[0] + n[1]) * factor) + 2, TOP};
    const uint64_t q = coded.quantile();
    if (q >= TOP) return false;
    const int entry = (q >= share[1]) + (q >= share[2]);
    entries[i] = entry;
    coded.take(share[entry], share[entry + 1]);
    return true;
  });
}

}  // namespace SW_ARCH
