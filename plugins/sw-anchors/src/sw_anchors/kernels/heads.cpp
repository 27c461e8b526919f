// The three networks of anchors and the Gaussians that they spawn, and the gradient.
//
// Blocks of anchors are worked through with everything in the second cache. Gradients of weights are summed by a number
// of groups of blocks that does not depend on the number of threads, then group by group.
#include <algorithm>
#include <cmath>
#include <type_traits>
#include <vector>

#include "kernels.h"
#include <splatwizard/vectors.h>

namespace SW_ARCH {

using namespace sw_anchors;

namespace {

constexpr int64_t BLOCK = 96, GROUPS = 8;  // of anchors, a multiple of ROWS; sums of weights

// Sizes of the padded matrices.
struct Sizes {
  int64_t inputs, columns, head, width, k;
  Sizes(const Heads& heads, int64_t offsets)
      : inputs(heads.features + 5),  // the last one is 1, for the bias
        columns(padded(inputs, TILE)),
        head(padded(heads.hidden, LANES)),
        width(padded(kHeads * head, TILE)),
        k(offsets) {}
};

// The last layers with rows padded to whole vectors, head after head: [11 k, head].
struct LastLayers {
  std::vector<float> weights;
  const float* of[kHeads];
  LastLayers(const Heads& heads, const Sizes& size) : weights(11 * size.k * size.head) {
    float* to = weights.data();
    for (int h = 0; h < kHeads; ++h) {
      of[h] = to;
      for (int64_t row = 0; row < kOutputs[h] * size.k; ++row, to += size.head)
        std::copy_n(heads.last[h] + row * heads.hidden, heads.hidden, to);
    }
  }
};

// Inputs of the networks for anchors first .. first + BLOCK, [BLOCK, columns]; zeros beyond the last anchor.
void fill_inputs(const Anchors& from, const Seen& seen, const Heads& heads, const Sizes& size, int64_t first,
                 float* inputs) {
  const int64_t count = std::min(BLOCK, from.n - first), f = heads.features;
  std::fill_n(inputs, BLOCK * size.columns, 0.f);
  for (int64_t i = 0; i < count; ++i, inputs += size.columns) {
    std::copy_n(seen.features + (first + i) * seen.feature_row, f, inputs);
    float toward[3], square = 0.f;
    for (int axis = 0; axis < 3; ++axis) {
      toward[axis] = from.positions[3 * (first + i) + axis] - seen.center[axis];
      square += toward[axis] * toward[axis];
    }
    const float distance = std::sqrt(square);
    for (int axis = 0; axis < 3; ++axis) inputs[f + axis] = toward[axis] / distance;
    inputs[f + 3] = distance;
    inputs[f + 4] = 1.f;
  }
}

// N outputs of one head, the rows of `weights` being their own.
template <int N>
void outputs_of(const float* hidden, const float* weights, const float* bias, int64_t head, float* to) {
  Vec sum[N] = {};
  for (int64_t i = 0; i < head; i += LANES) {
    const Vec value = load(hidden + i);
#pragma GCC unroll 7
    for (int c = 0; c < N; ++c) sum[c] += value * load(weights + c * head + i);
  }
  float totals[N];
  lane_sums(sum, totals);
#pragma GCC unroll 7
  for (int c = 0; c < N; ++c) to[c] = bias[c] + totals[c];
}

// Adds to the gradient of the hidden layer of one Gaussian's anchor.
template <int N>
void add_to_hidden(const float* weights, const float* slope, int64_t head, float* to_hidden) {
  Vec factor[N];
#pragma GCC unroll 7
  for (int c = 0; c < N; ++c) factor[c] = all(slope[c]);
  for (int64_t i = 0; i < head; i += LANES) {
    Vec sum = load(to_hidden + i);
#pragma GCC unroll 7
    for (int c = 0; c < N; ++c) sum += factor[c] * load(weights + c * head + i);
    store(to_hidden + i, sum);
  }
}

// Gaussians of a block of anchors that have the same number among those of their anchor, and so the same weights.
struct Alike {
  int64_t count = 0;
  int64_t drawn[BLOCK];        // their numbers
  const float* hidden[BLOCK];  // of their anchors
};

// Adds to the gradients of the weights [N, head] and biases [N] of Gaussians alike, whose N slopes stand at
// slope + N drawn. Sums stay in registers over all of them.
template <int N>
void add_to_weights(const Alike& of, int64_t layer, const float* slope, int64_t head, float* to_weights,
                    float* to_bias) {
  constexpr int TOGETHER = N > 4 ? 1 : 2;  // vectors of a row
  for (int64_t n = 0; n < of.count; ++n)
#pragma GCC unroll 7
    for (int c = 0; c < N; ++c) to_bias[c] += slope[N * of.drawn[n] + c];
  int64_t i = 0;
  const auto columns = [&](auto width) {
    constexpr int W = decltype(width)::value;
    Vec sum[N][W];
#pragma GCC unroll 7
    for (int c = 0; c < N; ++c)
#pragma GCC unroll 2
      for (int v = 0; v < W; ++v) sum[c][v] = load(to_weights + c * head + i + v * LANES);
    for (int64_t n = 0; n < of.count; ++n) {
      const float* const own = slope + N * of.drawn[n];
      const float* const from = of.hidden[n] + layer + i;
#pragma GCC unroll 7
      for (int c = 0; c < N; ++c) {
        const Vec factor = all(own[c]);
#pragma GCC unroll 2
        for (int v = 0; v < W; ++v) sum[c][v] += factor * load(from + v * LANES);
      }
    }
#pragma GCC unroll 7
    for (int c = 0; c < N; ++c)
#pragma GCC unroll 2
      for (int v = 0; v < W; ++v) store(to_weights + c * head + i + v * LANES, sum[c][v]);
  };
  for (; i + TOGETHER * LANES <= head; i += TOGETHER * LANES) columns(std::integral_constant<int, TOGETHER>());
  for (; i < head; i += LANES) columns(std::integral_constant<int, 1>());
}

// Sigmoids of all outputs of the Gaussians begin .. end at once.
class Squashed {
 public:
  Squashed(const float* geometry, const float* color, int64_t begin, int64_t end)
      : begin_(begin), geometry_(padded(kGeometry * (end - begin), LANES)), color_(padded(3 * (end - begin), LANES)) {
    squash(geometry + kGeometry * begin, kGeometry * (end - begin), geometry_);
    squash(color + 3 * begin, 3 * (end - begin), color_);
  }
  float geometry(int64_t at) const { return geometry_[at - kGeometry * begin_]; }
  float color(int64_t at) const { return color_[at - 3 * begin_]; }

 private:
  static void squash(const float* from, int64_t count, std::vector<float>& to) {
    std::copy_n(from, count, to.data());
    for (size_t i = 0; i < to.size(); i += LANES)
      store(&to[i], all(1.f) / (all(1.f) + exponential(-load(&to[i]))));
  }
  int64_t begin_;
  std::vector<float> geometry_, color_;
};

}  // namespace

int64_t heads_rows(int64_t n) { return padded(n, BLOCK); }

int64_t heads_width(const Heads& heads) { return Sizes(heads, 1).width; }

void heads_opacities(const Anchors& from, const Seen& seen, const Heads& heads, float* hidden, float* alpha,
                     float* opacities, const splatwizard::Parallel& parallel) {
  const Sizes size(heads, from.k);
  const LastLayers last(heads, size);
  std::vector<float> first(size.inputs * size.width);  // [inputs, width]
  for (int h = 0; h < kHeads; ++h)
    for (int64_t row = 0; row < heads.hidden; ++row) {
      for (int64_t i = 0; i < heads.features + 4; ++i)
        first[i * size.width + h * size.head + row] = heads.first[h][row * (heads.features + 4) + i];
      first[(heads.features + 4) * size.width + h * size.head + row] = heads.first_bias[h][row];
    }
  parallel(heads_rows(from.n) / BLOCK, 1, [&](int64_t begin, int64_t end) {
    std::vector<float> inputs(BLOCK * size.columns);
    for (int64_t block = begin; block < end; ++block) {
      const int64_t start = block * BLOCK, count = std::min(BLOCK, from.n - start);
      float* to = hidden + start * size.width;
      fill_inputs(from, seen, heads, size, start, inputs.data());
      product<false>(inputs.data(), size.columns, 1, first.data(), size.width, size.inputs, to, size.width, BLOCK,
                     size.width);
      for (int64_t i = 0; i < BLOCK * size.width; i += LANES) {
        const Vec value = load(to + i);
        store(to + i, value > Vec{} ? value : Vec{});
      }
      float* const block_alpha = alpha + start * from.k;
      for (int64_t a = 0; a < count; ++a) {
        const float* row = to + a * size.width;
        float* const own = block_alpha + a * from.k;
        int64_t j = 0;
        for (; j + 4 <= from.k; j += 4)
          outputs_of<4>(row, last.of[0] + j * size.head, heads.last_bias[0] + j, size.head, own + j);
        for (; j < from.k; ++j)
          outputs_of<1>(row, last.of[0] + j * size.head, heads.last_bias[0] + j, size.head, own + j);
      }
      for (int64_t i = 0; i < count * from.k; i += LANES) {  // tanh(x) = 1 - 2 / (e^2x + 1)
        float padded_values[LANES] = {};
        const int64_t some = std::min<int64_t>(LANES, count * from.k - i);
        std::copy_n(block_alpha + i, some, padded_values);
        store(padded_values, all(1.f) - all(2.f) / (exponential(load(padded_values) * all(2.f)) + all(1.f)));
        std::copy_n(padded_values, some, block_alpha + i);
      }
      for (int64_t i = start * from.k; i < (start + count) * from.k; ++i)
        opacities[i] = from.masks == nullptr ? alpha[i] : alpha[i] * from.masks[i];
    }
  });
}

void heads_spawn(const Anchors& from, const Heads& heads, const float* hidden, float* geometry, float* color,
                 const Gaussians& to, const splatwizard::Parallel& parallel) {
  const Sizes size(heads, from.k);
  const LastLayers last(heads, size);
  parallel(from.count, 256, [&](int64_t begin, int64_t end) {
    for (int64_t m = begin; m < end; ++m) {
      const int64_t a = from.drawn[m] / from.k, j = from.drawn[m] % from.k;
      const float* row = hidden + a * size.width + size.head;
      outputs_of<kGeometry>(row, last.of[1] + kGeometry * j * size.head, heads.last_bias[1] + kGeometry * j,
                            size.head, geometry + kGeometry * m);
      outputs_of<3>(row + size.head, last.of[2] + 3 * j * size.head, heads.last_bias[2] + 3 * j, size.head,
                    color + 3 * m);
    }
    const Squashed sigmoids(geometry, color, begin, end);
    for (int64_t m = begin; m < end; ++m) spawn_one(from, m, to, sigmoids);
  });
}

void heads_backward(const Anchors& from, const Seen& seen, const Heads& heads, const float* hidden,
                    const Gaussians& slope, const Gradients& to, float* to_features, const HeadGradients& to_heads,
                    const splatwizard::Parallel& parallel) {
  const Sizes size(heads, from.k);
  const LastLayers last(heads, size);
  std::vector<float> first(padded(size.width, ROWS) * size.columns);  // [width, columns]: first layers, side by side
  for (int h = 0; h < kHeads; ++h)
    for (int64_t row = 0; row < heads.hidden; ++row)
      std::copy_n(heads.first[h] + row * (heads.features + 4), heads.features,
                  first.data() + (h * size.head + row) * size.columns);
  const int64_t blocks = heads_rows(from.n) / BLOCK;
  const int64_t rows = padded(size.width, ROWS), outputs = 11 * size.k;  // of the sums
  const int64_t summed = rows * size.columns + outputs * (size.head + 1);
  std::vector<float> sums(GROUPS * summed);

  parallel(GROUPS, 1, [&](int64_t begin, int64_t end) {
    std::vector<float> inputs(BLOCK * size.columns), to_inputs(BLOCK * size.columns);
    std::vector<float> to_hidden(BLOCK * size.width + ROWS), to_opacity;
    std::vector<Alike> alike(size.k);
    for (int64_t group = begin; group < end; ++group) {
      float* const to_first = sums.data() + group * summed;
      float* const to_last = to_first + rows * size.columns;
      float* const to_bias = to_last + outputs * size.head;
      for (int64_t block = group * blocks / GROUPS; block < (group + 1) * blocks / GROUPS; ++block) {
        const int64_t start = block * BLOCK, count = std::min(BLOCK, from.n - start);
        const auto place = [&](int64_t anchor) {
          return std::lower_bound(from.drawn, from.drawn + from.count, anchor * from.k) - from.drawn;
        };
        std::fill(to_hidden.begin(), to_hidden.end(), 0.f);
        for (Alike& some : alike) some.count = 0;
        const int64_t begin_drawn = place(start), end_drawn = place(start + count);
        const Squashed sigmoids(from.geometry, from.color, begin_drawn, end_drawn);
        to_opacity.resize(size_t(end_drawn - begin_drawn));
        for (int64_t m = begin_drawn; m < end_drawn; ++m) {
          const int64_t i = from.drawn[m], a = i / from.k, j = i % from.k;
          spawn_one_backward(from, m, slope, to, [](float* where, float value) { *where += value; }, sigmoids);
          float* to_row = to_hidden.data() + (a - start) * size.width;
          float& own = to_opacity[size_t(m - begin_drawn)];
          own = to.alpha[i] * (1.f - from.alpha[i] * from.alpha[i]);
          add_to_hidden<1>(last.of[0] + j * size.head, &own, size.head, to_row);
          add_to_hidden<kGeometry>(last.of[1] + kGeometry * j * size.head, to.geometry + kGeometry * m, size.head,
                                   to_row + size.head);
          add_to_hidden<3>(last.of[2] + 3 * j * size.head, to.color + 3 * m, size.head, to_row + 2 * size.head);
          Alike& same = alike[size_t(j)];
          same.drawn[same.count] = m, same.hidden[same.count++] = hidden + a * size.width;
        }
        for (int64_t j = 0; j < size.k; ++j) {
          const int64_t g = size.k + kGeometry * j, c = (1 + kGeometry) * size.k + 3 * j;
          add_to_weights<1>(alike[size_t(j)], 0, to_opacity.data() - begin_drawn, size.head, to_last + j * size.head,
                            to_bias + j);
          add_to_weights<kGeometry>(alike[size_t(j)], size.head, to.geometry, size.head, to_last + g * size.head,
                                    to_bias + g);
          add_to_weights<3>(alike[size_t(j)], 2 * size.head, to.color, size.head, to_last + c * size.head,
                            to_bias + c);
        }
        const float* const own = hidden + start * size.width;
        for (int64_t i = 0; i < BLOCK * size.width; i += LANES)
          store(&to_hidden[i], load(own + i) > Vec{} ? load(&to_hidden[i]) : Vec{});
        fill_inputs(from, seen, heads, size, start, inputs.data());
        product<true>(to_hidden.data(), 1, size.width, inputs.data(), size.columns, BLOCK, to_first, size.columns,
                      rows, size.columns);
        product<false>(to_hidden.data(), size.width, 1, first.data(), size.columns, size.width, to_inputs.data(),
                       size.columns, BLOCK, size.columns);
        for (int64_t a = 0; a < count; ++a)
          std::copy_n(to_inputs.data() + a * size.columns, heads.features, to_features + (start + a) * heads.features);
      }
    }
  });

  for (int64_t group = 1; group < GROUPS; ++group)
    for (int64_t i = 0; i < summed; ++i) sums[i] += sums[group * summed + i];
  const float* to_last = sums.data() + rows * size.columns;
  const float* to_bias = to_last + outputs * size.head;
  for (int h = 0; h < kHeads; ++h) {
    for (int64_t row = 0; row < heads.hidden; ++row) {
      const float* found = sums.data() + (h * size.head + row) * size.columns;
      std::copy_n(found, heads.features + 4, to_heads.first[h] + row * (heads.features + 4));
      to_heads.first_bias[h][row] = found[heads.features + 4];
    }
    for (int64_t row = 0; row < kOutputs[h] * size.k; ++row, to_last += size.head)
      std::copy_n(to_last, heads.hidden, to_heads.last[h] + row * heads.hidden);
    std::copy_n(to_bias, kOutputs[h] * size.k, to_heads.last_bias[h]);
    to_bias += kOutputs[h] * size.k;
  }
}

}  // namespace SW_ARCH
