// Quantiser steps that a network predicts, and the gradient, on the CPU; blocks and sums as in heads.cpp.
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include <splatwizard/vectors.h>

namespace SW_ARCH {

using namespace sw_anchors;

namespace {

constexpr int64_t BLOCK = 96, GROUPS = 8;
constexpr int OUTPUTS = 3;

struct Sizes {
  int64_t inputs, columns, width;
  explicit Sizes(const StepNetwork& of)
      : inputs(of.inputs + 1),  // the last one is 1, for the bias
        columns(padded(inputs, TILE)),
        width(padded(of.hidden, TILE)) {}
};

void fill_inputs(const StepNetwork& of, const Sizes& size, int64_t first, float* inputs) {
  const int64_t count = std::min(BLOCK, of.count - first);
  std::fill_n(inputs, BLOCK * size.columns, 0.f);
  for (int64_t i = 0; i < count; ++i, inputs += size.columns) {
    std::copy_n(of.features + (first + i) * of.inputs, of.inputs, inputs);
    inputs[of.inputs] = 1.f;
  }
}

// Weights [rows, columns] with rows `stride` apart.
std::vector<float> padded_rows(const float* from, int64_t rows, int64_t columns, int64_t count, int64_t stride) {
  std::vector<float> to(count * stride);
  for (int64_t row = 0; row < rows; ++row) std::copy_n(from + row * columns, columns, to.data() + row * stride);
  return to;
}

}  // namespace

void predicted_steps(const StepNetwork& of, float* hidden, float* tangents, float* steps,
                     const splatwizard::Parallel& parallel) {
  const Sizes size(of);
  const std::vector<float> last = padded_rows(of.last, OUTPUTS, of.hidden, OUTPUTS, size.width);
  std::vector<float> first(size.inputs * size.width);
  for (int64_t row = 0; row < of.hidden; ++row) {
    for (int64_t i = 0; i < of.inputs; ++i) first[i * size.width + row] = of.first[row * of.inputs + i];
    first[of.inputs * size.width + row] = of.first_bias[row];
  }
  parallel((of.count + BLOCK - 1) / BLOCK, 1, [&](int64_t begin, int64_t end) {
    std::vector<float> inputs(BLOCK * size.columns), rows(BLOCK * size.width);
    for (int64_t block = begin; block < end; ++block) {
      const int64_t start = block * BLOCK, count = std::min(BLOCK, of.count - start);
      fill_inputs(of, size, start, inputs.data());
      product<false>(inputs.data(), size.columns, 1, first.data(), size.width, size.inputs, rows.data(), size.width,
                     BLOCK, size.width);
      for (int64_t a = 0; a < count; ++a) {
        float* const row = rows.data() + a * size.width;
        Vec sums[OUTPUTS] = {};
        for (int64_t i = 0; i < size.width; i += LANES) {
          const Vec raw = load(row + i), value = raw > Vec{} ? raw : Vec{};
          store(row + i, value);
#pragma GCC unroll 3
          for (int o = 0; o < OUTPUTS; ++o) sums[o] += value * load(&last[o * size.width + i]);
        }
        std::copy_n(row, of.hidden, hidden + (start + a) * of.hidden);
        for (int o = 0; o < OUTPUTS; ++o) {
          float total = of.last_bias[o];
#pragma GCC unroll 16
          for (int i = 0; i < LANES; ++i) total += sums[o][i];
          const float tangent = std::tanh(total);
          tangents[OUTPUTS * (start + a) + o] = tangent;
          steps[OUTPUTS * (start + a) + o] = of.base[o] * std::max(of.offset + tangent, of.smallest);
        }
      }
    }
  });
}

void predicted_steps_backward(const StepNetwork& of, const float* hidden, const float* tangents, const float* to_steps,
                              const float* to_hidden, const StepGradients& to,
                              const splatwizard::Parallel& parallel) {
  const Sizes size(of);
  const int64_t rows = padded(size.width, ROWS), blocks = (of.count + BLOCK - 1) / BLOCK;
  const std::vector<float> last = padded_rows(of.last, OUTPUTS, of.hidden, OUTPUTS, size.width);
  const std::vector<float> first = padded_rows(of.first, of.hidden, of.inputs, rows, size.columns);
  const int64_t summed = rows * size.columns + OUTPUTS * (size.width + 1);
  std::vector<float> sums(GROUPS * summed);
  parallel(GROUPS, 1, [&](int64_t begin, int64_t end) {
    std::vector<float> inputs(BLOCK * size.columns), to_inputs(BLOCK * size.columns);
    std::vector<float> slopes(BLOCK * size.width + ROWS), value(size.width);
    for (int64_t group = begin; group < end; ++group) {
      float* const to_first = sums.data() + group * summed;
      float* const to_last = to_first + rows * size.columns;
      float* const to_bias = to_last + OUTPUTS * size.width;
      for (int64_t block = group * blocks / GROUPS; block < (group + 1) * blocks / GROUPS; ++block) {
        const int64_t start = block * BLOCK, count = std::min(BLOCK, of.count - start);
        std::fill(slopes.begin(), slopes.end(), 0.f);
        for (int64_t a = 0; a < count; ++a) {
          const int64_t at = start + a;
          float* const slope = slopes.data() + a * size.width;
          std::copy_n(hidden + at * of.hidden, of.hidden, value.data());
          std::copy_n(to_hidden + at * of.hidden, of.hidden, slope);
          for (int o = 0; o < OUTPUTS; ++o) {
            const float tangent = tangents[OUTPUTS * at + o];
            const bool bounded = of.offset + tangent < of.smallest;
            const float by = bounded ? 0.f : to_steps[OUTPUTS * at + o] * of.base[o] * (1.f - tangent * tangent);
            to_bias[o] += by;
            for (int64_t i = 0; i < size.width; i += LANES) {
              store(slope + i, load(slope + i) + all(by) * load(&last[o * size.width + i]));
              float* const sum = to_last + o * size.width + i;
              store(sum, load(sum) + all(by) * load(&value[i]));
            }
          }
          for (int64_t i = 0; i < size.width; i += LANES)
            store(slope + i, load(&value[i]) > Vec{} ? load(slope + i) : Vec{});
        }
        fill_inputs(of, size, start, inputs.data());
        product<true>(slopes.data(), 1, size.width, inputs.data(), size.columns, BLOCK, to_first, size.columns, rows,
                      size.columns);
        product<false>(slopes.data(), size.width, 1, first.data(), size.columns, size.width, to_inputs.data(),
                       size.columns, BLOCK, size.columns);
        for (int64_t a = 0; a < count; ++a)
          std::copy_n(to_inputs.data() + a * size.columns, of.inputs, to.features + (start + a) * of.inputs);
      }
    }
  });
  for (int64_t group = 1; group < GROUPS; ++group)
    for (int64_t i = 0; i < summed; ++i) sums[i] += sums[group * summed + i];
  for (int64_t row = 0; row < of.hidden; ++row) {
    std::copy_n(sums.data() + row * size.columns, of.inputs, to.first + row * of.inputs);
    to.first_bias[row] = sums[row * size.columns + of.inputs];
  }
  const float* const to_last = sums.data() + rows * size.columns;
  for (int o = 0; o < OUTPUTS; ++o) {
    std::copy_n(to_last + o * size.width, of.hidden, to.last + o * of.hidden);
    to.last_bias[o] = to_last[OUTPUTS * size.width + o];
  }
}

}  // namespace SW_ARCH
