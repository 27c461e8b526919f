// Layers of networks in eight bits (docs/bitstream.md, wisp).
#pragma once
#include "base.h"

namespace swz {

constexpr int LOWEST_EXPONENT = -24, EXACT_EXPONENT = -12, HIGHEST_EXPONENT = 5;

struct EightBitLayer {
  int64_t outputs = 0, inputs = 0;
  bool has_bias = false;
  Buffer<int64_t> weights;  // [outputs, inputs]
  Buffer<int8_t> exponents;
  Buffer<int16_t> biases;
  int own = 0;  // exponent of the biases

  void read(Bytes& from, int64_t rows, int64_t columns, bool biased);
  int lowest() const;  // of the exponents of its rows
  double weight(int64_t row, int64_t column) const;
  double bias(int64_t row) const;
};

}  // namespace swz
