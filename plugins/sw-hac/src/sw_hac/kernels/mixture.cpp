// Bits of a sample of anchors under predicted distributions (mixture.h), and inputs of the networks of channels, on the
// CPU: row by row.
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include <splatwizard/vector_math.h>

namespace SW_ARCH {

using namespace sw_hac;

namespace {

constexpr int SCALES = 6;

struct VectorMath {
  using Real = Vec;
  static Vec number(float x) { return all(x); }
  static Vec exponential(Vec x) { return SW_ARCH::exponential(x); }
  static Vec complement(Vec x) { return SW_ARCH::erfc(x); }
};

// What the vectors read of a row, then what they write. Features come first, then padding, then all other numbers.
struct Scratch {
  int64_t start, length;  // of the other numbers; of all
  std::vector<float> numbers;
  float *x, *step, *factor, *mean, *scale, *second_mean, *second_scale, *logit;
  float *mass, *by_x, *by_step, *by_mean, *by_scale, *by_second_mean, *by_second_scale, *by_logit;

  // Padding is a number that is certain, with a finite derivative.
  Scratch(int64_t features, int64_t others)
      : start(padded(features, LANES)), length(start + padded(others, LANES)), numbers(16 * length, 1.f) {
    int64_t i = 0;
    for (float** part : {&x, &step, &factor, &mean, &scale, &second_mean, &second_scale, &logit, &mass, &by_x, &by_step,
                         &by_mean, &by_scale, &by_second_mean, &by_second_scale, &by_logit})
      *part = numbers.data() + i++ * length;
  }
};

void one_gaussian(const Scratch& at, int64_t begin, int64_t end, const MixtureBounds& bounds) {
  for (int64_t i = begin; i < end; i += LANES) {
    const auto found = one_bits<VectorMath>(load(at.x + i), load(at.step + i), load(at.factor + i),
                                            {load(at.mean + i), load(at.scale + i)}, bounds);
    store(at.mass + i, found.probability), store(at.by_x + i, found.by_x), store(at.by_step + i, found.by_step);
    store(at.by_mean + i, found.by_first.mean), store(at.by_scale + i, found.by_first.scale);
  }
}

void two_gaussians(const Scratch& at, int64_t end, const MixtureBounds& bounds) {
  for (int64_t i = 0; i < end; i += LANES) {
    const auto found =
        two_bits<VectorMath>(load(at.x + i), load(at.step + i), load(at.factor + i),
                             {load(at.mean + i), load(at.scale + i)},
                             {load(at.second_mean + i), load(at.second_scale + i)}, load(at.logit + i), bounds);
    store(at.mass + i, found.probability), store(at.by_x + i, found.by_x), store(at.by_step + i, found.by_step);
    store(at.by_mean + i, found.by_first.mean), store(at.by_scale + i, found.by_first.scale);
    store(at.by_second_mean + i, found.by_second.mean), store(at.by_second_scale + i, found.by_second.scale);
    store(at.by_logit + i, found.by_logit);
  }
}

}  // namespace

void mixture_bits(const Mixture& from, const MixtureSlopes& to, const splatwizard::Parallel& parallel) {
  const int f = from.features, k = from.offsets, numbers = f + SCALES + 3 * k, logits = from.width - f;
  const int ends[] = {f, f + SCALES, numbers};
  parallel(from.count, 32, [&](int64_t begin, int64_t end) {
    Scratch at(f, numbers - f);
    const auto place = [&](int column) { return column < f ? column : at.start + column - f; };
    for (int64_t row = begin; row < end; ++row) {
      const float* const outputs = from.outputs + row * from.width;
      const float* const second = from.second == nullptr ? nullptr : from.second + row * 3 * f;
      const float* const masks = from.masks + row * k;
      const float* const steps = from.steps + row * 3;
      const bool there = std::any_of(masks, masks + k, [](float mask) { return mask > 0.f; });
      const float counted = from.counted[row], present = from.kind == kAlone || there ? counted : 0.f;
      for (int group = 0, column = 0; group < 3; ++group)
        for (; column < ends[group]; ++column) {
          const MixturePlace own = mixture_place(column, f, k);
          const int64_t i = place(column);
          at.x[i] = from.x[row * numbers + column], at.step[i] = steps[group];
          at.mean[i] = outputs[own.mean] * from.units[own.mean];
          at.scale[i] = outputs[own.mean + own.apart] * from.units[own.mean + own.apart];
          const float mask = group < 2 ? 1.f : masks[(column - f - SCALES) / 3];
          at.factor[i] = group == 2 && from.kind == kAlone ? mask : present * mask;
        }
      if (second != nullptr) {
        for (int i = 0; i < f; ++i) {
          at.second_mean[i] = from.base * second[from.columns[i]];
          at.second_scale[i] = from.base * second[from.columns[f + i]];
          at.logit[i] = outputs[logits + i] * from.units[logits + i] - second[from.columns[2 * f + i]];
        }
        two_gaussians(at, at.start, from.bounds);
      } else {
        one_gaussian(at, 0, at.start, from.bounds);
      }
      one_gaussian(at, at.start, at.length, from.bounds);

      for (int i = 0; i < f; ++i) at.mass[i] = -std::log2(at.mass[i]);
      for (int64_t i = at.start; i < at.start + numbers - f; ++i) at.mass[i] = -std::log2(at.mass[i]);
      float bits[3] = {}, by_step[3] = {};
      float* const to_masks = to.masks + row * k;
      for (int j = 0; j < k; ++j) {
        const float* const own = at.mass + at.start + SCALES + 3 * j;
        to_masks[j] = own[0] + own[1] + own[2];
        bits[2] += masks[j] * to_masks[j];
      }
      for (int group = 0, column = 0; group < 3; ++group)
        for (; column < ends[group]; ++column) {
          const int64_t i = place(column);
          bits[group] += group < 2 ? at.mass[i] : 0.f, by_step[group] += at.by_step[i];
        }
      const float whole = bits[0] + bits[1] + bits[2];
      for (int j = 0; j < k && from.kind != kAlone; ++j)
        to_masks[j] = present * to_masks[j] + (from.kind == kGatedMean ? counted * whole / float(k) : 0.f);
      for (int group = 0; group < 3; ++group) {
        to.bits[3 * row + group] = (group == 2 && from.kind == kAlone ? 1.f : present) * bits[group];
        to.steps[3 * row + group] = by_step[group];
      }

      float* const to_outputs = to.outputs + row * from.width;
      std::fill_n(to_outputs, from.width, 0.f);
      for (int column = 0; column < numbers; ++column) {
        const MixturePlace own = mixture_place(column, f, k);
        const int64_t i = place(column);
        to.x[row * numbers + column] = at.by_x[i];
        to_outputs[own.mean] = at.by_mean[i] * from.units[own.mean];
        to_outputs[own.mean + own.apart] = at.by_scale[i] * from.units[own.mean + own.apart];
      }
      if (second == nullptr) continue;
      float* const to_second = to.second + row * 3 * f;
      for (int i = 0; i < f; ++i) {
        to_second[from.columns[i]] = from.base * at.by_second_mean[i];
        to_second[from.columns[f + i]] = from.base * at.by_second_scale[i];
        to_second[from.columns[2 * f + i]] = -at.by_logit[i];
        to_outputs[logits + i] = at.by_logit[i] * from.units[logits + i];
      }
    }
  });
}

void channel_inputs(const Channels& of, const float* x, const float* outputs, float* to,
                    const splatwizard::Parallel& parallel) {
  std::vector<ChannelSource> sources(of.inputs);
  for (int column = 0; column < of.inputs; ++column)
    sources[column] = channel_source(column, of.features, of.width, of.context, of.units, of.base);
  parallel(of.count, 64, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row)
      for (int column = 0; column < of.inputs; ++column) {
        const ChannelSource& from = sources[column];
        const float value = from.x >= 0        ? x[row * of.numbers + from.x]
                            : from.output >= 0 ? outputs[row * of.width + from.output]
                                               : 1.f;
        to[row * of.inputs + column] = from.factor * value;
      }
  });
}

void channel_slopes(const Channels& of, const ChannelSlopes& by, float* to_x, float* to_outputs,
                    const splatwizard::Parallel& parallel) {
  std::vector<int> places(of.numbers + of.width, -1);
  std::vector<float> factors(of.numbers + of.width, 0.f);
  for (int column = 0; column < of.numbers + of.width && by.inputs != nullptr; ++column) {
    const int place = column < of.numbers
                          ? channel_input_of_x(column, of.features)
                          : channel_input_of_output(column - of.numbers, of.features, of.width, of.context);
    if (place < 0) continue;
    places[column] = place;
    factors[column] = channel_source(place, of.features, of.width, of.context, of.units, of.base).factor;
  }
  const float slope = *by.slope;
  parallel(of.count, 64, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const float* const inputs = by.inputs == nullptr ? nullptr : by.inputs + row * of.inputs;
      const auto through = [&](const float* own, int64_t width, const int* place, const float* factor, float* to) {
        for (int64_t i = 0; i < width; ++i)
          to[i] = slope * (own[i] + (place[i] < 0 ? 0.f : factor[i] * inputs[place[i]]));
      };
      through(by.x + row * of.numbers, of.numbers, places.data(), factors.data(), to_x + row * of.numbers);
      through(by.outputs + row * of.width, of.width, places.data() + of.numbers, factors.data() + of.numbers,
              to_outputs + row * of.width);
    }
  });
}

}  // namespace SW_ARCH
