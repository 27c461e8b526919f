#include "decimal.h"

#include <cstdint>

#include "base.h"

namespace swz {

namespace {

// Natural numbers below 2^6400: 512 digits, times or over a power of ten up to 10^860.
struct Natural {
  static constexpr int WORDS = 200;
  uint32_t word[WORDS] = {};
  int used = 0;

  void times_plus(uint32_t factor, uint32_t more) {
    uint64_t carry = more;
    for (int i = 0; i < used; ++i) {
      carry += uint64_t{word[i]} * factor;
      word[i] = static_cast<uint32_t>(carry);
      carry >>= 32;
    }
    if (carry) word[used++] = static_cast<uint32_t>(carry);
  }
  int bits() const { return used ? 32 * used - __builtin_clz(word[used - 1]) : 0; }
  void shift(int by) {
    for (; by >= 32; by -= 32) {
      std::memmove(word + 1, word, sizeof(uint32_t) * static_cast<size_t>(used));
      word[0] = 0;
      ++used;
    }
    if (by) times_plus(uint32_t{1} << by, 0);
  }
  // Takes another number off, if it is not the larger one.
  bool subtract(const Natural& other) {
    const int count = used > other.used ? used : other.used;
    int top = count - 1;
    while (top >= 0 && word[top] == other.word[top]) --top;
    if (top >= 0 && word[top] < other.word[top]) return false;
    int64_t borrow = 0;
    for (int i = 0; i < count; ++i) {
      borrow += int64_t{word[i]} - other.word[i];
      word[i] = static_cast<uint32_t>(borrow);
      borrow >>= 32;
    }
    while (used && word[used - 1] == 0) --used;
    return true;
  }
};

// Of top / bottom.
double quotient(Natural& top, Natural& bottom) {
  const int apart = top.bits() - bottom.bits();
  (apart < 0 ? top : bottom).shift(apart < 0 ? -apart : apart);
  uint64_t q = 0;  // 64 bits of it, the first one worth 2^apart; it or the second one is 1
  for (int i = 0; i < 64; ++i) {
    q = q << 1 | top.subtract(bottom);
    top.shift(1);
  }
  const bool more = top.used > 0;
  int lowest = apart - 63;  // exponent of the last bit
  const int leading = 63 - __builtin_clzll(q), kept_from_end = lowest + leading - 52;
  const int drop = (kept_from_end < -1074 ? -1074 : kept_from_end) - lowest;
  if (drop > 64) return 0;
  const uint64_t rest = drop == 64 ? q : q & ((uint64_t{1} << drop) - 1), half = uint64_t{1} << (drop - 1);
  q = drop == 64 ? 0 : q >> drop;
  lowest += drop;
  q += rest > half || (rest == half && (more || (q & 1)));
  if (lowest > 971) return __builtin_inf();
  return static_cast<double>(q) * power_of_two(lowest / 2) * power_of_two(lowest - lowest / 2);
}

}  // namespace

double nearest_float64(const char* text) {
  const bool negative = *text == '-';
  text += negative;
  Natural top, bottom;
  int exponent = 0, stated = 0, digits = 0;
  bool fraction = false;
  for (; *text && (*text | 32) != 'e'; ++text) {
    if (*text == '.') {
      fraction = true;
      continue;
    }
    top.times_plus(10, static_cast<uint32_t>(*text - '0'));
    digits += top.used > 0;
    exponent -= fraction;
  }
  if (*text) {
    const bool down = *++text == '-';
    for (text += down || *text == '+'; *text; ++text) stated = stated < 100000 ? 10 * stated + (*text - '0') : stated;
    exponent += down ? -stated : stated;
  }
  double found = 0;
  if (digits + exponent > 310 && digits) found = __builtin_inf();
  else if (digits + exponent > -330 && digits) {
    bottom.times_plus(1, 1);
    for (int i = 0; i < exponent; ++i) top.times_plus(10, 0);
    for (int i = 0; i < -exponent; ++i) bottom.times_plus(10, 0);
    found = quotient(top, bottom);
  }
  return negative ? -found : found;
}

}  // namespace swz
