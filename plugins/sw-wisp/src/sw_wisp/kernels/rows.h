// What a training step of wisp does with the numbers of one splat, for rows.cpp and cuda/rows.cu. The formulas stand in
// sw_wisp/shape.py, context.py, rounding.py and rate.py.
#pragma once

#include <cmath>
#include <cstdint>

#ifdef __CUDACC__
#define SW_WISP_HD __host__ __device__ __forceinline__
#define SW_UNROLL _Pragma("unroll")
#else
#define SW_WISP_HD inline __attribute__((always_inline))
#define SW_UNROLL _Pragma("GCC unroll 8")
#endif

namespace sw_wisp {

constexpr int kNumbers = 22, kBlocks = 4, kTies = 5, kFeatures = 69;
constexpr int kKnown = 10;                       // numbers that networks are told: all but the latents
constexpr int kInputs = kFeatures + kKnown;      // of a row of inputs
constexpr int kOutputs = 56, kTold = 42;         // of a row of outputs of all networks, and of what ties follow
constexpr int kColour = 7, kDrawn = 15;          // columns from kColour on are what the appearance network sees
constexpr int kMultipliers = 128;

// Columns that a network predicts at once (numbers.BLOCKS), and how they are drawn in parts (numbers.PARTS).
struct Block {
  int start, width, parts;
  int ends[3];   // of the parts, within the block
  int outputs;   // where a row of outputs has the means, then the scale levels, then the step outputs, then padding
  int end;       // where that of the next block begins
  int last_step; // columns from here on have the second step output
  int told;      // where a row of `told` has residuals, then their sizes; -1: nothing follows them
  int tie;       // the first of its ties
};

SW_WISP_HD constexpr Block block_of(int number) {
  switch (number) {
    case 0: return {0, 1, 1, {1, 0, 0}, 0, 4, 1, -1, 0};
    case 1: return {1, 6, 2, {3, 6, 0}, 4, 20, 5, 0, 0};
    case 2: return {7, 3, 3, {1, 2, 3}, 20, 28, 3, 12, 1};
    default: return {10, 12, 3, {4, 8, 12}, 28, 56, 12, 18, 3};
  }
}

enum Phase { kAsTheyAre, kNoise, kSoft, kHard };

constexpr float kSmallestScale = 0.05f, kScaleRate = 0.11356532f;  // ln(1280) / 63
constexpr float kHighestLevel = 63.f, kLeastProbability = 1.f / 65536.f;
constexpr float kLargestSize = 4.f, kRounding = 1.f / 12.f;

// The plan of a step: phase and sharpness of rounding, and the factor of its tangent, or where both stand when a step is
// replayed; whether steps follow the networks, and gradients the steps.
struct Plan {
  int phase;
  float sharpness, half;
  const float* soft;
  bool adaptive, moves_steps;

  SW_WISP_HD Plan now() const {
    Plan found = *this;
    if (soft != nullptr) found.sharpness = soft[0], found.half = soft[1];
    return found;
  }
};

// One block of all rows.
struct Draw {
  int block;
  Plan plan;
  int64_t rows;
  const float *values, *noise;  // [n,22]; noise may be null
  const float* outputs;
  float *inputs, *view_inputs;
  const float *base_steps, *multipliers;
  const float* ties[kTies];
  float *mean, *scale, *steps, *drawn, *told;  // told [n,kTold], others [n,22]
};

// The way back through all blocks; gradients [n,22] by forecasts and drawn values, null where there are none.
struct DrawBack {
  Plan plan;
  int64_t rows;
  const float *values, *noise, *mean, *steps;
  const float *outputs, *base_steps;
  const float *by_mean, *by_scale, *by_steps, *by_drawn;
  float *to_outputs, *to_values;
};

// Math: a Real, which is float or a vector of floats, one of each row; functions of it, so that each instruction set has
// some of its own: `number`, `exponential`, `bent` (tanh), `root`, `floor`, `nearest`, `complement` (the complementary
// error function), `look_up` in a table; `load` and `store`, of numbers that lie a row apart.

// A drawn number and its derivatives.
template <class Math, class Real = typename Math::Real>
struct Drawn {
  Real value, by_value, by_mean, by_step;
};

template <class Math, class Real = typename Math::Real>
SW_WISP_HD Real scale_ratio(Real level) {
  const Real zero = Math::number(0.f), highest = Math::number(kHighestLevel);
  const Real bounded = level < zero ? zero : level > highest ? highest : level;
  return Math::number(kSmallestScale) * Math::exponential(bounded * Math::number(kScaleRate));
}

// floor(y) + 1/2 + tanh(a (y - floor(y) - 1/2)) / (2 tanh(a/2)), and its derivative.
template <class Math, class Real = typename Math::Real>
SW_WISP_HD void soft_round(Real y, const Plan& plan, Real& value, Real& slope) {
  const Real middle = Math::floor(y) + Math::number(0.5f);
  const Real bent = Math::bent(Math::number(plan.sharpness) * (y - middle));
  value = middle + bent * Math::number(plan.half);
  slope = Math::number(plan.sharpness * plan.half) * (Math::number(1.f) - bent * bent);
}

template <class Math, class Real = typename Math::Real>
SW_WISP_HD Drawn<Math> drawn(const Plan& plan, Real value, Real mean, Real step, Real noise) {
  const Real one = Math::number(1.f), zero = Math::number(0.f);
  if (plan.phase == kAsTheyAre) return {value, one, zero, zero};
  if (plan.phase == kNoise) return {value + noise * step, one, zero, noise};
  const Real offset = (value - mean) / step;
  if (plan.phase == kSoft) {
    Real once, twice, first, second;
    soft_round<Math>(offset, plan, once, first);
    soft_round<Math>(once + noise, plan, twice, second);
    const Real slope = first * second;
    return {mean + step * twice, slope, one - slope, twice - offset * slope};
  }
  const Real k = Math::nearest(offset);
  return {mean + step * k, one, zero, k - offset};
}

// A block of one row, or of as many as a Real has: mean, scale and steps from the outputs of its network, and the values
// as they are drawn, part by part: what is told of one moves the next.
template <class Math, class Real = typename Math::Real>
SW_WISP_HD void draw_block(const Block& block, const Draw& of, int64_t row) {
  const Plan plan = of.plan.now();
  const int width = block.width;
  const float* const features = (block.start == kKnown ? of.view_inputs : of.inputs) + row * kInputs;
  const float *means = of.outputs + row * kOutputs + block.outputs, *scales = means + width, *turns = scales + width;
  Real residuals[12], sizes[12];
  int begin = 0;
  for (int part = 0; part < block.parts; ++part) {
    const int end = block.ends[part];
    const float* const tie = part == 0 ? nullptr : of.ties[block.tie + part - 1];
    for (int i = begin; i < end; ++i) {
      const int column = block.start + i;
      const Real unit = Math::number(of.base_steps[column]);
      Real step = unit;
      if (plan.adaptive) {
        const Real eight = Math::number(8.f), zero = Math::number(0.f), last = Math::number(kMultipliers - 1);
        const Real place = Math::floor((Math::load(turns + (i >= block.last_step), kOutputs) + eight) * eight);
        const Real upper = place > last ? last : place;
        step = unit * Math::look_up(of.multipliers, upper > zero ? upper : zero);  // the first too for no number
      }
      Real mean = (Math::load(features + column, kInputs) + Math::load(means + i, kOutputs)) * unit;
      Real scale = Math::load(scales + i, kOutputs);
      if (tie != nullptr) {
        const float *of_mean = tie + (i - begin) * begin, *of_scale = tie + (i - begin + end - begin) * begin;
        Real moved = Math::number(0.f), widened = moved;
        for (int j = 0; j < begin; ++j) {
          moved = moved + residuals[j] * Math::number(of_mean[j]);
          widened = widened + sizes[j] * Math::number(of_scale[j]);
        }
        mean = mean + moved * unit, scale = scale + widened;
      }
      const int64_t at = row * kNumbers + column;
      const Real noise = of.noise == nullptr ? Math::number(0.f) : Math::load(of.noise + at, kNumbers);
      const Real value = drawn<Math>(plan, Math::load(of.values + at, kNumbers), mean, step, noise).value;
      Math::store(of.mean + at, kNumbers, mean), Math::store(of.scale + at, kNumbers, scale);
      Math::store(of.steps + at, kNumbers, step), Math::store(of.drawn + at, kNumbers, value);
      if (column < kKnown) {  // what the networks of later blocks are told
        const int64_t known = row * kInputs + kFeatures + column;
        Math::store(of.inputs + known, kInputs, value / unit), Math::store(of.view_inputs + known, kInputs, value / unit);
      }
      if (block.told < 0) continue;
      const Real sigma = step * scale_ratio<Math>(scale), residual = value - mean, most = Math::number(kLargestSize);
      const Real away = residual < Math::number(0.f) ? -residual : residual;
      const Real size = away / Math::root(sigma * sigma + Math::number(kRounding) * step * step);
      residuals[i] = residual / unit, sizes[i] = size > most ? most : size;
      float* const told = of.told + row * kTold + block.told + i;
      Math::store(told, kTold, residuals[i]), Math::store(told + width, kTold, sizes[i]);
    }
    begin = end;
  }
}

// The way back through a block: by the outputs of its network, and by its values.
template <class Math, class Real = typename Math::Real>
SW_WISP_HD void draw_back(const Block& block, const DrawBack& of, int64_t row) {
  const Real zero = Math::number(0.f), one = Math::number(1.f);
  const Plan plan = of.plan.now();
  const bool moves = plan.adaptive && plan.moves_steps;
  Real first = zero, second = zero;
  const int scales = block.width, steps = 2 * block.width;
  const float* const outputs = of.outputs + row * kOutputs + block.outputs;
  float* const to = of.to_outputs + row * kOutputs + block.outputs;
  const auto given = [&](const float* by, int64_t at) { return by == nullptr ? zero : Math::load(by + at, kNumbers); };
  for (int i = 0; i < block.width; ++i) {
    const int column = block.start + i;
    const int64_t at = row * kNumbers + column;
    const Real unit = Math::number(of.base_steps[column]), by_drawn = given(of.by_drawn, at);
    const Drawn<Math> own = drawn<Math>(plan, Math::load(of.values + at, kNumbers),
                                        Math::load(of.mean + at, kNumbers), Math::load(of.steps + at, kNumbers),
                                        given(of.noise, at));
    Math::store(of.to_values + at, kNumbers, by_drawn * own.by_value);
    Math::store(to + i, kOutputs, (given(of.by_mean, at) + by_drawn * own.by_mean) * unit);
    Math::store(to + scales + i, kOutputs, given(of.by_scale, at));
    const Real by_step = (given(of.by_steps, at) + by_drawn * own.by_step) * unit;
    if (i < block.last_step)
      first = first + by_step;
    else
      second = second + by_step;
  }
  const int count = block.last_step < block.width ? 2 : 1;
  for (int i = 0; i < block.end - block.outputs - steps; ++i) {  // padding too: it is summed up with the rest
    Real by_turn = zero;
    if (moves && i < count) {
      const Real bent = Math::bent(Math::load(outputs + steps + i, kOutputs));
      by_turn = (i == 0 ? first : second) * (one - bent * bent);
    }
    Math::store(to + steps + i, kOutputs, by_turn);
  }
}

template <class Math, class Real = typename Math::Real>
struct Bits {
  Real probability, by_value, by_scale, by_step;  // derivatives of the bits; by the mean: -by_value
};

// Of the bin of one step around a drawn value, `residual` from the mean. Below the least probability it costs that much,
// and still pulls inwards; a scale level beyond its bounds has a gradient that leads back.
template <class Math, class Real = typename Math::Real>
SW_WISP_HD Bits<Math> bits_of(Real residual, Real level, Real step, Real factor) {
  const Real zero = Math::number(0.f), highest = Math::number(kHighestLevel), half = Math::number(0.5f) * step;
  const Real sigma = step * scale_ratio<Math>(level);
  const Real away = residual < zero ? -residual : residual, narrow = Math::number(0.70710678f) / sigma;
  const Real near = (away - half) * narrow, far = (away + half) * narrow;
  const Real mass = Math::number(0.5f) * (Math::complement(near) - Math::complement(far));
  const Real least = Math::number(kLeastProbability), p = mass < least ? least : mass;
  Real slope = factor * Math::number(-1.4426950409f) / p;  // 1 / ln 2
  slope = mass < least ? (slope < zero ? slope : zero) : slope;
  slope = slope * Math::number(0.56418958f);  // 1 / sqrt(pi)
  const Real at_near = slope * Math::exponential(-near * near), at_far = slope * Math::exponential(-far * far);
  const Real inner = (at_far - at_near) * narrow;
  const Real by_sigma = (at_near * near - at_far * far) / sigma, by_bounded = by_sigma * sigma * Math::number(kScaleRate);
  const Real upper = level > highest ? (by_bounded > zero ? by_bounded : zero) : by_bounded;
  return {p, residual > zero ? inner : residual < zero ? -inner : zero,
          level < zero ? (by_bounded < zero ? by_bounded : zero) : upper,
          Math::number(0.5f) * (at_near + at_far) * narrow + by_sigma * sigma / step};
}

// Eigenvalues of L, and eigenvectors: vectors[i] is the i-th coordinate of all three, one behind the other.
template <class Math, class Real = typename Math::Real>
struct Axes {
  Real values[3], vectors[3][3];
};

constexpr float kRootHalf = 0.70710678f, kRootSixth = 0.40824829f;

// Cyclic Jacobi of L, given by the deviator d and the size m.
template <class Math, class Real = typename Math::Real>
SW_WISP_HD Axes<Math> axes_of(const Real* d, Real m) {
  const Real one = Math::number(1.f), zero = Math::number(0.f), tiny = Math::number(1.1754944e-38f);
  const Real a = Math::number(kRootHalf), b = Math::number(kRootSixth);
  Real l[3][3];
  l[0][0] = a * d[0] - b * d[1] + m, l[1][1] = m - a * d[0] - b * d[1], l[2][2] = m + Math::number(2.f) * b * d[1];
  l[0][1] = a * d[2], l[0][2] = a * d[3], l[1][2] = a * d[4];
  Axes<Math> to;
  SW_UNROLL
  for (int i = 0; i < 3; ++i)
    SW_UNROLL
    for (int j = 0; j < 3; ++j) to.vectors[i][j] = i == j ? one : zero;
  for (int sweep = 0; sweep < 5; ++sweep)
    SW_UNROLL
    for (int pair = 0; pair < 3; ++pair) {
      const int p = pair == 2 ? 1 : 0, q = pair == 0 ? 1 : 2, r = 3 - p - q;
      Real &off = l[p][q], &pr = l[p < r ? p : r][p < r ? r : p], &qr = l[q < r ? q : r][q < r ? r : q];
      const Real twice = off + off, apart = l[q][q] - l[p][p];
      const Real length = Math::root(apart * apart + twice * twice) + tiny;
      const Real t = twice / (apart + (apart < zero ? -length : length));
      const Real c = one / Math::root(one + t * t), s = t * c, shift = t * off;
      l[p][p] = l[p][p] - shift, l[q][q] = l[q][q] + shift, off = zero;
      const Real first = pr;
      pr = c * first - s * qr, qr = s * first + c * qr;
      SW_UNROLL
      for (int i = 0; i < 3; ++i) {
        const Real own = to.vectors[i][p];
        to.vectors[i][p] = c * own - s * to.vectors[i][q], to.vectors[i][q] = s * own + c * to.vectors[i][q];
      }
    }
  SW_UNROLL
  for (int i = 0; i < 3; ++i) to.values[i] = l[i][i];
  return to;
}

template <class Math, class Real = typename Math::Real>
SW_WISP_HD Real bounded_by(Real value, float low, float high) {
  const Real least = Math::number(low), most = Math::number(high);
  return value < least ? least : value > most ? most : value;
}

// exp(2L), the six numbers xx, xy, xz, yy, yz, zz; eigenvalues clamped.
template <class Math, class Real = typename Math::Real>
SW_WISP_HD void covariance_of(const Axes<Math>& axes, float low, float high, Real* six) {
  Real squares[3];
  SW_UNROLL
  for (int k = 0; k < 3; ++k) {
    const Real scale = Math::exponential(bounded_by<Math>(axes.values[k], low, high));
    squares[k] = scale * scale;
  }
  int place = 0;
  SW_UNROLL
  for (int i = 0; i < 3; ++i)
    SW_UNROLL
    for (int j = i; j < 3; ++j) {
      Real sum = Math::number(0.f);
      SW_UNROLL
      for (int k = 0; k < 3; ++k) sum = sum + axes.vectors[i][k] * axes.vectors[j][k] * squares[k];
      six[place++] = sum;
    }
}

// (e^2a - e^2b) / (a - b).
template <class Math, class Real = typename Math::Real>
SW_WISP_HD Real divided_difference(Real a, Real b) {
  const Real apart = a - b, square = apart * apart, one = Math::number(1.f);
  const Real away = apart < Math::number(0.f) ? -apart : apart;
  // sinh(x) / x: a series below 1, where a difference would cancel.
  const Real near = one + square * (Math::number(1.f / 6) + square * (Math::number(1.f / 120) +
                    square * (Math::number(1.f / 5040) + square * Math::number(1.f / 362880))));
  const Real safe = away < one ? one : away;
  const Real far = Math::number(0.5f) * (Math::exponential(safe) - Math::exponential(-safe)) / safe;
  return Math::number(2.f) * Math::exponential(a + b) * (away < one ? near : far);
}

// From the gradient by the six numbers of exp(2L) that by d [5] and m. Beyond the bounds of eigenvalues only what leads
// back passes.
template <class Math, class Real = typename Math::Real>
SW_WISP_HD void covariance_back(const Axes<Math>& axes, const Real* by_six, float low, float high, Real* to_d,
                                Real& to_m) {
  const Real zero = Math::number(0.f), half = Math::number(0.5f);
  // The six numbers' gradient holds each off-diagonal entry of the symmetric one twice.
  const Real g[3][3] = {{by_six[0], half * by_six[1], half * by_six[2]},
                        {half * by_six[1], by_six[3], half * by_six[4]},
                        {half * by_six[2], half * by_six[4], by_six[5]}};
  Real bounded[3], left[3][3], inner[3][3];
  SW_UNROLL
  for (int i = 0; i < 3; ++i) {
    bounded[i] = bounded_by<Math>(axes.values[i], low, high);
    SW_UNROLL
    for (int j = 0; j < 3; ++j)  // g v
      left[i][j] = g[i][0] * axes.vectors[0][j] + g[i][1] * axes.vectors[1][j] + g[i][2] * axes.vectors[2][j];
  }
  SW_UNROLL
  for (int i = 0; i < 3; ++i)
    SW_UNROLL
    for (int j = i; j < 3; ++j) {  // v' g v, times the divided differences
      const Real sum = axes.vectors[0][i] * left[0][j] + axes.vectors[1][i] * left[1][j] +
                       axes.vectors[2][i] * left[2][j];
      inner[i][j] = inner[j][i] = sum * divided_difference<Math>(bounded[i], bounded[j]);
    }
  SW_UNROLL
  for (int i = 0; i < 3; ++i) {
    const Real own = inner[i][i], value = axes.values[i];
    const Real upper = value > Math::number(high) ? (own < zero ? zero : own) : own;
    inner[i][i] = value < Math::number(low) ? (own > zero ? zero : own) : upper;
  }
  SW_UNROLL
  for (int i = 0; i < 3; ++i)
    SW_UNROLL
    for (int j = 0; j < 3; ++j)  // v inner
      left[i][j] = axes.vectors[i][0] * inner[0][j] + axes.vectors[i][1] * inner[1][j] + axes.vectors[i][2] * inner[2][j];
  Real six[6];
  int place = 0;
  SW_UNROLL
  for (int i = 0; i < 3; ++i)
    SW_UNROLL
    for (int j = i; j < 3; ++j) {
      const Real sum =
          left[i][0] * axes.vectors[j][0] + left[i][1] * axes.vectors[j][1] + left[i][2] * axes.vectors[j][2];
      six[place++] = i == j ? sum : sum + sum;
    }
  const Real a = Math::number(kRootHalf), b = Math::number(kRootSixth);
  to_d[0] = a * (six[0] - six[3]), to_d[1] = b * (six[5] + six[5] - six[0] - six[3]);
  to_d[2] = a * six[1], to_d[3] = a * six[2], to_d[4] = a * six[4];
  to_m = six[0] + six[3] + six[5];
}

constexpr float kBandZero = 0.28209479177387814f;

// SH band 0 of luma and two chromas, and the way back: both are the same rotation, once transposed.
SW_WISP_HD void band_zero_of(const float* colour, float* dc) {
  const float a = 0.57735027f, b = 0.70710678f, c = 0.40824829f;
  const float rgb[3] = {a * colour[0] + b * colour[1] - c * colour[2], a * colour[0] + 2 * c * colour[2],
                        a * colour[0] - b * colour[1] - c * colour[2]};
  for (int i = 0; i < 3; ++i) dc[i] = (rgb[i] - 0.5f) / kBandZero;
}

SW_WISP_HD void band_zero_back(const float* by_dc, float* to_colour) {
  const float a = 0.57735027f, b = 0.70710678f, c = 0.40824829f;
  to_colour[0] = a * (by_dc[0] + by_dc[1] + by_dc[2]) / kBandZero;
  to_colour[1] = b * (by_dc[0] - by_dc[2]) / kBandZero;
  to_colour[2] = c * (2 * by_dc[1] - by_dc[0] - by_dc[2]) / kBandZero;
}

// A row of weights in eight bits: q 2^e with the exponent of least squared error.
constexpr int kHighestExponent = 5;

SW_WISP_HD double in_eight_bits(double weight, double unit, double per_unit) {
  const double q = rint(weight * per_unit);  // both are powers of two: exact
  return (q > 127. ? 127. : q < -127. ? -127. : q) * unit;
}

}  // namespace sw_wisp
