// Weights of a file, and networks of them in integers with 12 fractional bits (docs/bitstream.md, networks in integers).
#pragma once
#include <kernels.h>

#include "container.h"

namespace swz {

constexpr int64_t LEAK = 41;  // slope of leaky networks below 0, in 1/4096

// A layer as it stands in a file: W [outputs, inputs], then b.
struct FileLayer {
  const float *weights, *bias;
  int64_t inputs, outputs;
};

// The section `networks`: numbers, taken off the front.
struct Weights {
  Buffer<float> numbers;
  int64_t at = 0;

  // Refuses another number of them than `count`, and what is not finite.
  Weights(Container& file, int64_t count);

  const float* take(int64_t count) {
    at += count;
    return numbers.data + at - count;
  }
  FileLayer layer(int64_t inputs, int64_t outputs) {
    const float* weights = take(inputs * outputs);
    return {weights, take(outputs), inputs, outputs};
  }
};

// Numbers of a network inputs -> hidden -> outputs.
constexpr int64_t numbers_of(int64_t inputs, int64_t hidden, int64_t outputs) {
  return (inputs + 1) * hidden + (hidden + 1) * outputs;
}

struct IntegerNetwork {
  Buffer<double> numbers[5][2];
  splatwizard::Layer layers[5];
  int64_t depth = 0;

  // `scale` has a factor for each output of the last layer; null: 1. Refuses what is not exact, after the words `prefix`.
  IntegerNetwork() = default;
  IntegerNetwork(const FileLayer* from, int64_t count, const double* scale, const char* prefix = "ValueError: ");

  int64_t outputs() const { return layers[depth - 1].outputs; }
  // int64 [rows, outputs], of one or two inputs side by side.
  void operator()(int64_t rows, const int64_t* first, int64_t width, int64_t stride, const int64_t* second,
                  int64_t second_width, int64_t second_stride, int64_t* out, int64_t leak = 0) const;
  void operator()(int64_t rows, const int16_t* inputs, int64_t* out) const;
};

}  // namespace swz
