// A training step of wisp on the CPU: row by row, or as many rows at once as a vector has places.
#include <algorithm>
#include <cstring>

#include "cpu.h"
#include <splatwizard/vector_math.h>

namespace SW_ARCH {

using namespace sw_wisp;

namespace {

struct FloatMath {
  using Real = float;
  static float number(float x) { return x; }
  static float exponential(float x) { return std::exp(x); }
  static float bent(float x) { return std::tanh(x); }
  static float root(float x) { return std::sqrt(x); }
  static float floor(float x) { return std::floor(x); }
  static float nearest(float x) { return std::nearbyint(x); }
  static float look_up(const float* table, float index) { return table[int(index)]; }
  static float load(const float* from, int64_t) { return *from; }
  static void store(float* to, int64_t, float value) { *to = value; }
};

struct VectorMath {
  using Real = Vec;
  static Vec number(float x) { return all(x); }
  static Vec exponential(Vec x) { return SW_ARCH::exponential(x); }
  static Vec complement(Vec x) { return SW_ARCH::erfc(x); }
  static Vec bent(Vec x) { return all(1.f) - all(2.f) / (SW_ARCH::exponential(x + x) + all(1.f)); }
  static Vec root(Vec x) { return of_each(x, [](float lane) { return std::sqrt(lane); }); }
  static Vec floor(Vec x) { return of_each(x, [](float lane) { return std::floor(lane); }); }
  static Vec nearest(Vec x) { return of_each(x, [](float lane) { return std::nearbyint(lane); }); }
  static Vec look_up(const float* table, Vec index) {
    return of_each(index, [&](float lane) { return table[int(lane)]; });
  }
  static Vec load(const float* from, int64_t stride) {
    float lanes[LANES];
    for (int lane = 0; lane < LANES; ++lane) lanes[lane] = from[lane * stride];
    return SW_ARCH::load(lanes);
  }
  static void store(float* to, int64_t stride, Vec value) {
    float lanes[LANES];
    SW_ARCH::store(lanes, value);
    for (int lane = 0; lane < LANES; ++lane) to[lane * stride] = lanes[lane];
  }

 private:
  template <class Function>
  static Vec of_each(Vec x, const Function& function) {
    float lanes[LANES];
    SW_ARCH::store(lanes, x);
    for (float& lane : lanes) lane = function(lane);
    return SW_ARCH::load(lanes);
  }
};

// As many rows at once as a vector has places, then what is left one by one.
template <class Vectors, class One>
void each_row(int64_t begin, int64_t end, const Vectors& vectors, const One& one) {
  int64_t row = begin;
  for (; row + LANES <= end; row += LANES) vectors(row);
  for (; row < end; ++row) one(row);
}

// `count` columns of up to LANES rows that lie `stride` apart, one vector for each column; rows beyond `rows` are 0.
void load_columns(const float* from, int64_t stride, int64_t rows, int count, Vec* to) {
  for (int column = 0; column < count; ++column) {
    float lanes[LANES] = {};
    for (int64_t row = 0; row < rows; ++row) lanes[row] = from[row * stride + column];
    to[column] = load(lanes);
  }
}

void store_columns(const Vec* from, int64_t stride, int64_t rows, int count, float* to) {
  for (int column = 0; column < count; ++column) {
    float lanes[LANES];
    store(lanes, from[column]);
    for (int64_t row = 0; row < rows; ++row) to[row * stride + column] = lanes[row];
  }
}

}  // namespace

void eight_bits(const Matrices& of, const splatwizard::Parallel& parallel) {
  for (int i = 0; i < of.count; ++i) {
    const Matrix& matrix = of.each[i];
    parallel(matrix.rows, 8, [&](int64_t begin, int64_t end) {
      for (int64_t row = begin; row < end; ++row) {
        const float* const weights = matrix.weights + row * matrix.columns;
        double least = HUGE_VAL, best = 1.;
        for (int exponent = of.lowest; exponent <= kHighestExponent; ++exponent) {
          const double unit = std::ldexp(1., exponent), per_unit = std::ldexp(1., -exponent);
          double error = 0.;
          for (int64_t j = 0; j < matrix.columns; ++j) {
            const double off = in_eight_bits(weights[j], unit, per_unit) - double(weights[j]);
            error += off * off;
          }
          if (error < least) least = error, best = unit;
        }
        for (int64_t j = 0; j < matrix.columns; ++j)
          matrix.rounded[row * matrix.columns + j] = float(in_eight_bits(weights[j], best, 1. / best));
      }
    });
  }
}

void draw(const Draw& of, const splatwizard::Parallel& parallel) {
  const Block block = block_of(of.block);
  parallel(of.rows, 64, [&](int64_t begin, int64_t end) {
    each_row(begin, end, [&](int64_t row) { draw_block<VectorMath>(block, of, row); },
             [&](int64_t row) { draw_block<FloatMath>(block, of, row); });
  });
}

void draw_backward(const DrawBack& of, const splatwizard::Parallel& parallel) {
  parallel(of.rows, 64, [&](int64_t begin, int64_t end) {
    for (int number = 0; number < kBlocks; ++number) {
      const Block block = block_of(number);
      each_row(begin, end, [&](int64_t row) { draw_back<VectorMath>(block, of, row); },
               [&](int64_t row) { draw_back<FloatMath>(block, of, row); });
    }
  });
}

void bits(const CountedRows& of, const splatwizard::Parallel& parallel) {
  const int64_t skipped = (of.rows - of.last) * kNumbers;
  const float *const values = of.values + skipped, *const mean = of.mean + skipped, *const scale = of.scale + skipped;
  const float* const steps = of.steps + skipped;
  parallel(of.last * kNumbers, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += LANES) {
      const int64_t count = std::min<int64_t>(LANES, end - i);
      float lanes[4][LANES];
      for (int64_t lane = 0; lane < LANES; ++lane) {
        const int64_t at = i + std::min(lane, count - 1);
        lanes[0][lane] = values[at] - mean[at], lanes[1][lane] = scale[at], lanes[2][lane] = steps[at];
      }
      const auto found = bits_of<VectorMath>(load(lanes[0]), load(lanes[1]), load(lanes[2]), all(1.f));
      store(lanes[3], found.probability);
      for (int64_t lane = 0; lane < count; ++lane) of.bits[i + lane] = -std::log2(lanes[3][lane]);
    }
  });
}

void bits_backward(const CountedRows& of, const splatwizard::Parallel& parallel) {
  const int64_t skipped = (of.rows - of.last) * kNumbers;
  for (float* const each : {of.to_values, of.to_mean, of.to_scale, of.to_steps}) std::fill_n(each, skipped, 0.f);
  parallel(of.last * kNumbers, 1024, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; i += LANES) {
      const int64_t count = std::min<int64_t>(LANES, end - i);
      float lanes[4][LANES];
      for (int64_t lane = 0; lane < LANES; ++lane) {
        const int64_t own = i + std::min(lane, count - 1), at = skipped + own;
        lanes[0][lane] = of.values[at] - of.mean[at], lanes[1][lane] = of.scale[at], lanes[2][lane] = of.steps[at];
        lanes[3][lane] = of.by_bits[own];
      }
      const auto found = bits_of<VectorMath>(load(lanes[0]), load(lanes[1]), load(lanes[2]), load(lanes[3]));
      store(lanes[0], found.by_value), store(lanes[1], found.by_scale), store(lanes[2], found.by_step);
      for (int64_t lane = 0; lane < count; ++lane) {
        const int64_t at = skipped + i + lane;
        of.to_values[at] = lanes[0][lane], of.to_mean[at] = -lanes[0][lane];
        of.to_scale[at] = lanes[1][lane], of.to_steps[at] = lanes[2][lane];
      }
    }
  });
}

void splats(const Splats& of, const splatwizard::Parallel& parallel) {
  parallel((of.rows + LANES - 1) / LANES, 16, [&](int64_t begin, int64_t end) {
    for (int64_t part = begin; part < end; ++part) {
      const int64_t first = part * LANES, count = std::min<int64_t>(LANES, of.rows - first);
      Vec numbers[6], edges, six[6], axes[12];
      load_columns(of.values + first * kNumbers + 1, kNumbers, count, 6, numbers);
      load_columns(of.log_edges + first, 1, count, 1, &edges);
      const auto found = axes_of<VectorMath>(numbers, numbers[5] + edges);
      covariance_of<VectorMath>(found, of.low, of.high, six);
      for (int i = 0; i < 3; ++i) {
        axes[i] = found.values[i];
        for (int j = 0; j < 3; ++j) axes[3 + 3 * i + j] = found.vectors[i][j];
      }
      store_columns(six, 6, count, 6, of.covariances + first * 6);
      store_columns(axes, 12, count, 12, of.axes + first * 12);
      for (int64_t row = first; row < first + count; ++row) {
        const float* const values = of.values + row * kNumbers;
        of.opacities[row] = 1.f / (1.f + std::exp(-values[0]));
        band_zero_of(values + kColour, of.dc + row * 3);
      }
    }
  });
}

void splats_backward(const SplatsBack& of, const splatwizard::Parallel& parallel) {
  parallel((of.rows + LANES - 1) / LANES, 16, [&](int64_t begin, int64_t end) {
    for (int64_t part = begin; part < end; ++part) {
      const int64_t first = part * LANES, count = std::min<int64_t>(LANES, of.rows - first);
      float* const to = of.to_values + first * kNumbers;
      std::fill_n(to, count * kNumbers, 0.f);
      if (of.by_covariances != nullptr) {
        Vec given[12], by[6], found[6];
        load_columns(of.axes + first * 12, 12, count, 12, given);
        load_columns(of.by_covariances + first * 6, 6, count, 6, by);
        Axes<VectorMath> axes;
        for (int i = 0; i < 3; ++i) {
          axes.values[i] = given[i];
          for (int j = 0; j < 3; ++j) axes.vectors[i][j] = given[3 + 3 * i + j];
        }
        covariance_back<VectorMath>(axes, by, of.low, of.high, found, found[5]);
        store_columns(found, kNumbers, count, 6, to + 1);
      }
      for (int64_t row = first; row < first + count; ++row) {
        float* const own = of.to_values + row * kNumbers;
        const float opacity = of.opacities[row];
        if (of.by_opacities != nullptr) own[0] = of.by_opacities[row] * (1.f - opacity) * opacity;
        if (of.by_dc != nullptr) band_zero_back(of.by_dc + row * 3, own + kColour);
        if (of.by_colour == nullptr) continue;
        for (int i = 0; i < kDrawn; ++i) own[kColour + i] += of.by_colour[row * kDrawn + i];
      }
    }
  });
}

}  // namespace SW_ARCH
