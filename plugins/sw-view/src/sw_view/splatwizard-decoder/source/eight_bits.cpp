#include "eight_bits.h"

#include "columns.h"

namespace swz {

void EightBitLayer::read(Bytes& from, int64_t rows, int64_t columns, bool biased) {
  outputs = rows, inputs = columns, has_bias = biased;
  if (rows * columns > 8 * from.left + 4096)
    refuse("a network of ", grouped(rows), " x ", grouped(columns), " weights is not there");
  weights = Buffer<int64_t>(rows * columns);
  Columns matrix(from.take(from.length()), rows * columns, 1);
  matrix.next(weights.data);
  matrix.finish();
  exponents = Buffer<int8_t>(rows);
  std::memcpy(exponents.data, from.take(rows).data, static_cast<size_t>(rows));
  own = static_cast<int8_t>(from.integer(1));
  biases = Buffer<int16_t>(biased ? rows : 0);
  std::memcpy(biases.data, from.take(2 * biases.size).data, static_cast<size_t>(2 * biases.size));
  bool fits = own >= LOWEST_EXPONENT && own <= HIGHEST_EXPONENT, small = true;
  for (int64_t i = 0; i < rows; ++i) fits &= exponents[i] >= LOWEST_EXPONENT && exponents[i] <= HIGHEST_EXPONENT;
  if (!fits) refuse("an exponent of a network is out of range");
  for (int64_t i = 0; i < weights.size; ++i) small &= weights[i] >= -127 && weights[i] <= 127;
  for (int64_t i = 0; i < biases.size; ++i) small &= biases[i] != INT16_MIN;
  if (!small) refuse("a weight of a network is out of range");
}

int EightBitLayer::lowest() const {
  int least = HIGHEST_EXPONENT;
  for (int64_t i = 0; i < outputs; ++i) least = exponents[i] < least ? exponents[i] : least;
  return least;
}

double EightBitLayer::weight(int64_t row, int64_t column) const {
  return static_cast<double>(weights[inputs * row + column]) * power_of_two(exponents[row]);
}

double EightBitLayer::bias(int64_t row) const { return has_bias ? biases[row] * power_of_two(own) : 0; }

}  // namespace swz
