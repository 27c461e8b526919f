// Range coding of numbers under mixtures: words as the library constriction has them (docs/bitstream.md, range coder).
//
// A row of counts is never made: the sum of those before an entry follows from the sums of both tables.
#include "mixtures.h"
#include "ranges.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

// The model of one number: shares of 2^24 before each of its entries. All sums are integers, exact in float64.
struct Window {
  const double* sums[2];
  int64_t start[2], last[2];
  double weight[2], before[2], factor;
  int64_t entries;

  Window(const MixtureArgs& a, int64_t row) {
    const int64_t width = a.width[row];
    entries = 2 * width + 2;
    weight[0] = a.weight[row];
    weight[1] = 256 - weight[0];
    double total = 1;
    for (int c = 0; c < 2; ++c) {
      const int16_t table = a.number[2 * row + c];
      sums[c] = a.below + a.first[table];
      start[c] = a.shift[2 * row + c] - width + a.radius[table];
      last[c] = 2 * a.radius[table] + 1;
      before[c] = at(c, 0);
      total += weight[c] * a.escape[table];
    }
    total += below(entries - 1);
    factor = static_cast<double>(TOP - static_cast<uint64_t>(entries)) / total;
  }
  double at(int c, int64_t entry) const {
    const int64_t place = start[c] + entry;
    return sums[c][place < 0 ? 0 : place > last[c] ? last[c] : place];
  }
  double below(int64_t entry) const {
    return static_cast<double>(entry) + weight[0] * (at(0, entry) - before[0]) + weight[1] * (at(1, entry) - before[1]);
  }
  uint64_t share(int64_t entry) const {
    return entry == entries ? TOP : static_cast<uint64_t>(below(entry) * factor) + static_cast<uint64_t>(entry);
  }
};

}  // namespace

int32_t decode_mixtures(const MixtureArgs& a, const uint8_t* words, int64_t bytes, int32_t* entries) {
  RangeReader coded(words, bytes);
  for (int64_t i = 0; i < a.n; ++i) {
    const Window window(a, a.order[i]);
    const uint64_t q = coded.quantile();
    if (q >= TOP) return WORDS_LEFT;
    // From the middle outwards, where most numbers lie, and then between the last two.
    int64_t entry = 0, end = window.entries, step = 1;
    uint64_t first = 0, last = TOP;
    const auto seen = [&](int64_t at) {
      const uint64_t share = window.share(at);
      const bool below = share <= q;
      (below ? entry : end) = at;
      (below ? first : last) = share;
      return below;
    };
    if (seen(end / 2 - 1))
      while (entry + step < end && seen(entry + step)) step *= 2;
    else
      while (end - step > entry && !seen(end - step)) step *= 2;
    while (end - entry > 1) seen((entry + end) / 2);
    entries[a.order[i]] = static_cast<int32_t>(entry);
    coded.take(first, last);
  }
  return FINE;
}

// Bytes written. A word that a carry may still change is held back, with those behind it that are all ones.
int64_t encode_mixtures(const MixtureArgs& a, const int32_t* entries, uint8_t* words) {
  int64_t bytes = 0, held = 0;
  uint64_t low = 0, range = ~uint64_t{0};
  uint32_t first = 0;
  const auto put = [&](uint32_t word) {
    for (int i = 0; i < 4; ++i) words[bytes++] = static_cast<uint8_t>(word >> (8 * i));
  };
  const auto release = [&](bool carry) {
    put(first + carry);
    for (int64_t i = 1; i < held; ++i) put(carry ? 0u : ~0u);
    held = 0;
  };
  for (int64_t i = 0; i < a.n; ++i) {
    const Window window(a, a.order[i]);
    const int64_t entry = entries[a.order[i]];
    const uint64_t scale = range >> BITS, share = window.share(entry), next = low + scale * share;
    range = scale * (window.share(entry + 1) - share);
    if (held > 0 && next + range > next) release(next < low);
    low = next;
    if (range < uint64_t{1} << 32) {
      const auto word = static_cast<uint32_t>(low >> 32);
      low <<= 32;
      range <<= 32;
      if (held > 0) {
        ++held;
      } else if (low + range > low) {
        put(word);
      } else {
        held = 1;
        first = word;
      }
    }
  }
  if (a.n == 0) return 0;
  const uint64_t point = low + ((uint64_t{1} << 32) - 1);
  if (held > 0) release(point < low);
  put(static_cast<uint32_t>(point >> 32));
  if ((low + range) >> 32 == point >> 32) put(0);
  return bytes;
}

}  // namespace SW_ARCH
