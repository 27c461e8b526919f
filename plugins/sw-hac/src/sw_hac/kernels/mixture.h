// Bits of a sample of anchors under what networks predict: each number under a Gaussian, a feature perhaps under a
// mixture of two. The mathematics of one number, for mixture.cpp and cuda/mixture.cu.
//
// A bin of width q at x has p = (erfc(near) - erfc(far)) / 2 under N(mean, deviation), where near and far are the
// distances of its ends from the mean over sqrt(2) deviations. Bits are -log2 p; p is that of both, by their weights.
#pragma once

#include <cstdint>

#ifdef __CUDACC__
#define SW_MIXTURE_HD __host__ __device__ __forceinline__
#else
#define SW_MIXTURE_HD inline __attribute__((always_inline))
#endif

namespace sw_hac {

// What masks do to the bits of their anchor. kAlone: those of an offset are multiplied by its mask, and its mask has
// them as its gradient. kGated: an anchor without masks has no bits at all. kGatedMean: and all its bits are multiplied
// by whether it has any, whose gradient is that of the mean of the masks.
enum MaskKind { kAlone, kGated, kGatedMean };

struct MixtureBounds {
  float smallest;        // probability
  float smallest_scale;  // of a deviation, if there is no floor in steps: no gradient below
  float scale_floor;     // of a deviation, in steps, and see REACH; 0: none. A gradient that raises the deviation passes
};

// Of S anchors, F features, k offsets. A row of `outputs` has means and deviations of features, then of 6 scales, then
// of 3 k coordinates, then numbers that say nothing here; if there is a second Gaussian, logits of features at its end.
struct Mixture {
  int64_t count;
  int features, offsets, width;  // F, k, W
  const float* x;                // [S,F+6+3k]
  const float *outputs, *units;  // [S,W], [W]: these times those are what they stand for
  const float* second;           // [S,3F] mean and deviation in units of `base`, logit; or null
  const int* columns;            // [3,F]: where a feature has them in a row of `second`; or null
  const float *steps, *masks, *counted;  // [S,3], [S,k], [S] factors of the bits of an anchor
  float base;
  MixtureBounds bounds;
  MaskKind kind;
};

// Bits [S,3] by group, and derivatives of their sum by the members of Mixture.
struct MixtureSlopes {
  float *bits, *x, *outputs, *steps, *masks, *second;
};

// Where `outputs` has the mean of a number, and how far behind it its deviation.
struct MixturePlace {
  int mean, apart;
};

SW_MIXTURE_HD MixturePlace mixture_place(int column, int features, int offsets) {
  if (column < features) return {column, features};
  if (column < features + 6) return {column + features, 6};
  return {column + features + 6, 3 * offsets};
}

// The networks of channels of S anchors: sizes of rows of x, outputs and inputs; others as of Mixture.
struct Channels {
  int64_t count;
  int features, numbers, width, inputs;
  const float* units;
  float base;
  bool context;
};

// Derivatives of the bits by x [S,numbers], outputs [S,width] and inputs [S,inputs] (or null), by the bits a scalar.
struct ChannelSlopes {
  const float *slope, *x, *outputs, *inputs;
};

// Inputs of the networks of channels: features in units of `base`, likewise the means and deviations of the first
// Gaussian, and logits, if they see them; then 1 and zeros. Where they come from: a column of x or of outputs, or -1.
struct ChannelSource {
  int x, output;
  float factor;
};

SW_MIXTURE_HD ChannelSource channel_source(int column, int features, int width, bool context, const float* units,
                                           float base) {
  const int part = column / features, own = column - part * features;
  if (part == 0) return {own, -1, 1.f / base};
  if (!context || part > 3) return {-1, -1, column == features * (context ? 4 : 1) ? 1.f : 0.f};
  const int output = part == 3 ? width - features + own : column - features;
  return {-1, output, part == 3 ? units[output] : units[output] / base};
}

// The way back: the input that has a column of x or of outputs in it, or -1.
SW_MIXTURE_HD int channel_input_of_x(int column, int features) { return column < features ? column : -1; }

SW_MIXTURE_HD int channel_input_of_output(int column, int features, int width, bool context) {
  if (!context) return -1;
  if (column < 2 * features) return features + column;
  return column < width - features ? -1 : 4 * features + column - width;
}

// Math: a Real, which is float or a vector of floats; `number`, `exponential`, and `complement`, the complementary
// error function. So each instruction set has functions of its own.
template <class Math, class Real = typename Math::Real>
struct BinMass {
  Real value, by_x, by_deviation, by_step;  // by the mean: -by_x
};

template <class Math, class Real = typename Math::Real>
SW_MIXTURE_HD BinMass<Math> bin_mass(Real x, Real mean, Real deviation, Real step) {
  const Real zero = Math::number(0.f), half = Math::number(0.5f) * step;
  const Real offset = x - mean, away = offset < zero ? -offset : offset;
  const Real narrow = Math::number(0.70710678f) / deviation;  // 1 / sqrt(2)
  const Real near = (away - half) * narrow, far = (away + half) * narrow;
  const Real value = Math::number(0.5f) * (Math::complement(near) - Math::complement(far));
  const Real rate = Math::number(0.56418958f);  // 1 / sqrt(pi)
  const Real at_near = rate * Math::exponential(-near * near), at_far = rate * Math::exponential(-far * far);
  const Real inner = (at_far - at_near) * narrow;
  return {value, offset > zero ? inner : offset < zero ? -inner : zero, (at_near * near - at_far * far) / deviation,
          Math::number(0.5f) * (at_near + at_far) * narrow};
}

// A Gaussian of a number as predicted: its mean and deviation; or derivatives by these.
template <class Math, class Real = typename Math::Real>
struct Normal {
  Real mean, scale;
};

// The floor of a deviation, for a number `offset` from the mean: with a floor in steps a number is at most REACH
// deviations away, since beyond that its gradient falls to 0, and a column that is there for all anchors stays there.
constexpr float REACH = 5.f;  // sw_anchors.rate_model.REACH

template <class Math, class Real = typename Math::Real>
SW_MIXTURE_HD Real least_scale(Real step, Real offset, const MixtureBounds& bounds) {
  if (!(bounds.scale_floor > 0.f)) return Math::number(bounds.smallest_scale);
  const Real in_steps = Math::number(bounds.scale_floor) * step, zero = Math::number(0.f);
  const Real in_reach = Math::number(1.f / REACH) * (offset < zero ? -offset : offset);
  return in_steps < in_reach ? in_reach : in_steps;
}

template <class Math, class Real = typename Math::Real>
SW_MIXTURE_HD Real bounded_below(Real value, Real least) {
  return value < least ? least : value;  // what is not a number stays so
}

// The derivative by a deviation as predicted, from that by the bounded one.
template <class Math, class Real = typename Math::Real>
SW_MIXTURE_HD Real through_floor(Real slope, Real scale, Real least, const MixtureBounds& bounds) {
  const Real zero = Math::number(0.f);
  const Real below = bounds.scale_floor > 0.f ? (slope < zero ? slope : zero) : zero;
  return scale < least ? below : slope;
}

// A number's probability, at least the smallest, and the derivatives of its bits times `factor` >= 0. Below the
// smallest a probability still has the gradient that raises it: that of bits that count is negative.
template <class Math, class Real = typename Math::Real>
struct OneBits {
  Real probability, by_x, by_step;
  Normal<Math> by_first;
};

template <class Math, class Real = typename Math::Real>
SW_MIXTURE_HD Real slope_of_probability(Real factor, Real probability) {
  return factor * Math::number(-1.4426950409f) / probability;  // 1 / ln 2
}

template <class Math, class Real = typename Math::Real>
SW_MIXTURE_HD OneBits<Math> one_bits(Real x, Real step, Real factor, const Normal<Math>& first,
                                     const MixtureBounds& bounds) {
  const Real least = least_scale<Math>(step, x - first.mean, bounds);
  const BinMass<Math> mass = bin_mass<Math>(x, first.mean, bounded_below<Math>(first.scale, least), step);
  const Real p = bounded_below<Math>(mass.value, Math::number(bounds.smallest));
  const Real slope = slope_of_probability<Math>(factor, p), by_x = slope * mass.by_x;
  return {p, by_x, slope * mass.by_step,
          {-by_x, through_floor<Math>(slope * mass.by_deviation, first.scale, least, bounds)}};
}

template <class Math, class Real = typename Math::Real>
struct TwoBits {
  Real probability, by_x, by_step;
  Normal<Math> by_first, by_second;
  Real by_logit;
};

// logit: that of the first Gaussian less that of the second.
template <class Math, class Real = typename Math::Real>
SW_MIXTURE_HD TwoBits<Math> two_bits(Real x, Real step, Real factor, const Normal<Math>& first,
                                     const Normal<Math>& second, Real logit, const MixtureBounds& bounds) {
  const Real zero = Math::number(0.f), one = Math::number(1.f);
  const Real least_a = least_scale<Math>(step, x - first.mean, bounds);
  const Real least_b = least_scale<Math>(step, x - second.mean, bounds);
  const BinMass<Math> a = bin_mass<Math>(x, first.mean, bounded_below<Math>(first.scale, least_a), step);
  const BinMass<Math> b = bin_mass<Math>(x, second.mean, bounded_below<Math>(second.scale, least_b), step);
  // Both weights from the exponential that cannot overflow, so that the small one is as precise as the large one.
  const Real tail = Math::exponential(logit < zero ? logit : -logit), large = one / (one + tail), small = tail * large;
  const Real weight = logit < zero ? small : large, other = logit < zero ? large : small;
  const Real p = bounded_below<Math>(weight * a.value + other * b.value, Math::number(bounds.smallest));
  const Real slope = slope_of_probability<Math>(factor, p), to_a = slope * weight, to_b = slope * other;
  const Real by_a = to_a * a.by_x, by_b = to_b * b.by_x;
  return {p,
          by_a + by_b,
          to_a * a.by_step + to_b * b.by_step,
          {-by_a, through_floor<Math>(to_a * a.by_deviation, first.scale, least_a, bounds)},
          {-by_b, through_floor<Math>(to_b * b.by_deviation, second.scale, least_b, bounds)},
          to_a * other * (a.value - b.value)};
}

}  // namespace sw_hac
