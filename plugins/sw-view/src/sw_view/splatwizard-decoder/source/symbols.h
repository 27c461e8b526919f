// Range-coded symbols under tables of counts (docs/bitstream.md, building blocks).
#pragma once
#include <ranges.h>

#include "base.h"

namespace swz {

constexpr int MAX_TABLE = 4096;
constexpr char DAMAGED_WORDS[] =
    "entropy decoding failed: AssertionError: Tried to decode from compressed data that is invalid for the employed entropy "
    "model.";
constexpr char CRC_DIFFERS[] = "the decoded symbols do not match their CRC-32: damaged data or a wrong model";

// A table of counts as a model.
struct Model {
  Buffer<uint32_t> share;  // c_0 .. c_K
  uint16_t bucket[1024];   // the symbol of the smallest number with these leading ten bits
  int64_t only = -1;       // the one symbol that has a count, if there is no other

  Model(const int64_t* counts, int64_t size);

  int32_t symbol(arch_native::RangeReader& words) const {
    const uint64_t q = words.quantile();
    if (q >= arch_native::TOP)
      refuse(DAMAGED_WORDS);
    int32_t found = bucket[q >> (arch_native::BITS - 10)];
    while (share[found + 1] <= q) ++found;
    words.take(share[found], share[found + 1]);
    return found;
  }
};

// Range-coded words, and the CRC-32 of the symbols that were taken from them.
struct Symbols {
  arch_native::RangeReader words;
  int64_t count = 0;
  uint32_t crc = 0;

  explicit Symbols(Bytes data) : words(data.data, data.left) {
    if (data.left % 4) refuse(grouped(data.left), " coded bytes are not whole 32-bit words");
  }
  void take(const Model& model, int32_t* symbols, int64_t number) {
    if (model.only >= 0)
      for (int64_t i = 0; i < number; ++i) symbols[i] = static_cast<int32_t>(model.only);
    else
      for (int64_t i = 0; i < number; ++i) symbols[i] = model.symbol(words);
    count += number;
    crc = crc32(symbols, 4 * number, crc);
  }
  void check(uint64_t expected) const {
    if (crc != expected) refuse(CRC_DIFFERS);
  }
};

// Stored count tables of these sizes, one after another. Refuses what no encoder writes.
Buffer<int64_t> stored_tables(Bytes& from, const int64_t* sizes, int64_t tables);

}  // namespace swz
