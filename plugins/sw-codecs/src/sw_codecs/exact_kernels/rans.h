// rANS words and escape codes of one stream, as docs/bitstream.md has them.
//
// Everything here is static or in SW_ARCH: no function of one instruction set may stand in for that of another.
#pragma once
#include <cstdint>
#include <cstdlib>
#include <cstring>
#include <new>

#include "kernels.h"

namespace SW_ARCH {

using splatwizard::Tables;

constexpr int BITS = 24;
constexpr uint64_t MASK = (uint64_t{1} << BITS) - 1;

// Memory of a task.
template <class T>
struct Scratch {
  explicit Scratch(int64_t n) : data(static_cast<T*>(std::malloc(sizeof(T) * static_cast<size_t>(n > 0 ? n : 1)))) {
    if (data == nullptr) throw std::bad_alloc();
  }
  ~Scratch() { std::free(data); }
  Scratch(const Scratch&) = delete;
  Scratch& operator=(const Scratch&) = delete;
  T& operator[](int64_t i) const { return data[i]; }
  T* data;
};

inline uint32_t word_at(const uint8_t* bytes) {
  return bytes[0] | uint32_t{bytes[1]} << 8 | uint32_t{bytes[2]} << 16 | uint32_t{bytes[3]} << 24;
}

// Takes words from the last one backwards.
struct WordReader {
  const uint8_t* words;
  int64_t left;
  uint64_t state = 0;
  bool damaged;  // no encoder ends with a word of 0

  WordReader(const uint8_t* data, int64_t bytes)
      : words(data), left(bytes / 4), damaged(left > 0 && word_at(words + 4 * (left - 1)) == 0) {
    while (state < uint64_t{1} << 32 && left > 0) state = state << 32 | word_at(words + 4 * --left);
  }
  bool used_up() const { return !damaged && left == 0 && state == 0; }

  // The entry of a table.
  int32_t entry(const int32_t* shares, const uint16_t* bucket) {
    const auto q = static_cast<int32_t>(state & MASK);
    int32_t s = bucket[q >> (BITS - 8)];
    while (shares[s + 1] <= q) ++s;
    const auto low = static_cast<uint64_t>(shares[s]);
    state = (state >> BITS) * (static_cast<uint64_t>(shares[s + 1]) - low) + static_cast<uint64_t>(q) - low;
    if (state < uint64_t{1} << 32 && left > 0) state = state << 32 | word_at(words + 4 * --left);
    return s;
  }
};

// Puts what is decoded last first.
struct WordWriter {
  uint8_t* words;
  int64_t bytes = 0;
  uint64_t state = 0;

  explicit WordWriter(uint8_t* data) : words(data) {}
  void word(uint64_t value) {
    for (int i = 0; i < 4; ++i) words[bytes++] = static_cast<uint8_t>(value >> (8 * i));
  }
  void put(const int32_t* shares, int32_t s) {
    const auto low = static_cast<uint64_t>(shares[s]);
    const uint64_t share = static_cast<uint64_t>(shares[s + 1]) - low;
    if (state >> (64 - BITS) >= share) {
      word(state);
      state >>= 32;
    }
    state = (state / share) << BITS | (low + state % share);
  }
  void finish() {
    for (; state > 0; state >>= 32) word(state);
  }
};

constexpr int MOST_ZEROS = 39;

// Sign bits and Exp-Golomb codes, bits from the least significant one of each byte up.
struct EscapeReader {
  const uint8_t* data;
  int64_t bits, at = 0;
  bool damaged = false;

  EscapeReader(const uint8_t* bytes, int64_t count) : data(bytes), bits(8 * count) {}
  int next() {
    if (at >= bits) {
      damaged = true;
      return 1;
    }
    const int bit = data[at >> 3] >> (at & 7) & 1;
    ++at;
    return bit;
  }
  // What is beyond a radius, signed; 0 where the code is damaged.
  int64_t beyond(int64_t radius) {
    const int negative = next();
    int zeros = 0;
    while (!next()) {
      if (++zeros > MOST_ZEROS) damaged = true;
      if (damaged) return 0;
    }
    int64_t value = 1;
    for (int i = 0; i < zeros; ++i) value = value << 1 | next();
    value += radius;  // value is the magnitude beyond the radius, plus one
    if (damaged) return 0;
    return negative ? -value : value;
  }
  bool used_up() const {
    if (damaged || bits - at >= 8) return false;
    for (int64_t i = at; i < bits; ++i)
      if (data[i >> 3] >> (i & 7) & 1) return false;
    return true;
  }
};

struct EscapeWriter {
  uint8_t* data;
  int64_t at = 0;

  explicit EscapeWriter(uint8_t* bytes) : data(bytes) {}
  void bit(int64_t value) {
    if ((at & 7) == 0) data[at >> 3] = 0;
    data[at >> 3] = static_cast<uint8_t>(data[at >> 3] | value << (at & 7));
    ++at;
  }
  void beyond(int64_t offset, int64_t radius) {
    bit(offset < 0);
    const int64_t value = (offset < 0 ? -offset : offset) - radius;
    int length = 0;
    while (value >> (length + 1)) ++length;
    for (int i = 0; i < length; ++i) bit(0);
    for (int i = length; i >= 0; --i) bit(value >> i & 1);
  }
  int64_t bytes() const { return (at + 7) >> 3; }
};

}  // namespace SW_ARCH
