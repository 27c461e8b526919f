// Noisy values of anchors, and the gradient, on the CPU: one pass over the rows each way.
#include <algorithm>
#include <cmath>

#include "kernels.h"
#include <splatwizard/vectors.h>

namespace SW_ARCH {

using namespace sw_anchors;

namespace {

constexpr int64_t SCALES = 6;

// to = from + step (u - 1/2), or from without noise.
void add_noise(const float* from, const float* uniform, float step, int64_t count, float* to) {
  if (uniform == nullptr)
    std::copy_n(from, count, to);
  else
    for (int64_t i = 0; i < count; ++i) to[i] = from[i] + step * (uniform[i] - 0.5f);
}

// Gradient by the step.
float of_step(const float* slope, const float* uniform, int64_t count) {
  float sum = 0.f;
#pragma omp simd reduction(+ : sum)
  for (int64_t i = 0; i < count; ++i) sum += slope[i] * (uniform[i] - 0.5f);
  return sum;
}

constexpr int64_t BUFFER = 16;  // whole vectors, whatever their width

// e^(sign x) of `count` numbers, at most BUFFER.
void exponentials(const float* from, int64_t count, float sign, float* to) {
  float values[BUFFER] = {};
  for (int64_t i = 0; i < count; ++i) values[i] = sign * from[i];
  for (int64_t i = 0; i < count; i += LANES) store(values + i, exponential(load(values + i)));
  std::copy_n(values, count, to);
}

// Sigmoids of the mask logits [k] of an anchor.
void soft_masks(const float* logits, int64_t k, float* to) {
  for (int64_t first = 0; first < k; first += BUFFER) {
    const int64_t some = std::min(BUFFER, k - first);
    exponentials(logits + first, some, -1.f, to + first);
    for (int64_t j = first; j < first + some; ++j) to[j] = 1.f / (1.f + to[j]);
  }
}

const int64_t* first_drawn(const Rows& from, int64_t place) {
  return std::lower_bound(from.drawn, from.drawn + from.samples, place);
}

}  // namespace

void noisy_values(const Rows& from, const RowValues& to, const splatwizard::Parallel& parallel) {
  const int64_t f = from.features, k = from.k, width = f + SCALES + 3 * k;
  parallel(from.count, 256, [&](int64_t begin, int64_t end) {
    const int64_t* next = first_drawn(from, begin);
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = from.rows[i];
      const float* u = from.uniform == nullptr ? nullptr : from.uniform + i * width;
      const float none[kGroups] = {};
      const float* step = from.steps == nullptr ? none : from.steps + i * from.step_row;
      float scales[SCALES];
      exponentials(from.log_scales + row * SCALES, SCALES, 1.f, scales);
      add_noise(from.of_features + row * f, u, step[0], f, to.features + i * f);
      add_noise(scales, u == nullptr ? u : u + f, step[1], SCALES, to.scales + i * SCALES);
      add_noise(from.of_offsets + row * 3 * k, u == nullptr ? u : u + f + SCALES, step[2], 3 * k,
                to.offsets + i * 3 * k);
      const float weight = from.mask_weights == nullptr ? 1.f : from.mask_weights[row];
      float* const masks = to.masks + i * k;
      soft_masks(from.mask_logits + row * k, k, masks);
      for (int64_t j = 0; j < k; ++j) masks[j] = masks[j] * weight > from.threshold ? 1.f : 0.f;
      if (next < from.drawn + from.samples && *next == i) {
        float* sample = to.sample + (next - from.drawn) * width;
        std::copy_n(to.features + i * f, f, sample);
        std::copy_n(to.scales + i * SCALES, SCALES, sample + f);
        std::copy_n(to.offsets + i * 3 * k, 3 * k, sample + f + SCALES);
        ++next;
      }
    }
  });
}

void noisy_values_backward(const Rows& from, const RowValues& slope, const RowGradients& to,
                           const splatwizard::Parallel& parallel) {
  const int64_t f = from.features, k = from.k, width = f + SCALES + 3 * k;
  parallel(from.count, 256, [&](int64_t begin, int64_t end) {
    const int64_t* next = first_drawn(from, begin);
    for (int64_t i = begin; i < end; ++i) {
      const int64_t row = from.rows[i];
      const float* sample = nullptr;
      if (next < from.drawn + from.samples && *next == i) sample = slope.sample + (next++ - from.drawn) * width;
      const auto sum = [&](const float* own, const float* sampled, int64_t count, float* place) {
        for (int64_t c = 0; c < count; ++c) place[c] = sampled == nullptr ? own[c] : own[c] + sampled[c];
      };
      float* const features = to.features + row * f;
      float* const offsets = to.offsets + row * 3 * k;
      float scales[SCALES];
      sum(slope.features + i * f, sample, f, features);
      sum(slope.scales + i * SCALES, sample == nullptr ? sample : sample + f, SCALES, scales);
      sum(slope.offsets + i * 3 * k, sample == nullptr ? sample : sample + f + SCALES, 3 * k, offsets);
      if (to.steps != nullptr) {
        const float* u = from.uniform + i * width;
        to.steps[kGroups * i] = of_step(features, u, f);
        to.steps[kGroups * i + 1] = of_step(scales, u + f, SCALES);
        to.steps[kGroups * i + 2] = of_step(offsets, u + f + SCALES, 3 * k);
      }
      float* const log_scales = to.log_scales + row * SCALES;
      exponentials(from.log_scales + row * SCALES, SCALES, 1.f, log_scales);
      for (int64_t c = 0; c < SCALES; ++c) log_scales[c] *= scales[c];
      const float weight = from.mask_weights == nullptr ? 1.f : from.mask_weights[row];
      float* const logits = to.mask_logits + row * k;
      soft_masks(from.mask_logits + row * k, k, logits);
      for (int64_t j = 0; j < k; ++j) logits[j] = slope.masks[i * k + j] * weight * logits[j] * (1.f - logits[j]);
    }
  });
}

}  // namespace SW_ARCH
