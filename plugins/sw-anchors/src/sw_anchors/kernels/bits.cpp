// Bits of a sample of anchors under predicted Gaussians, with their derivatives, on the CPU.
//
// Bits of a number x in a bin of width q under N(mean, deviation): -log2 p, p = (erfc(near) - erfc(far)) / 2, where near
// and far are the distances of the bin's ends from the mean over sqrt(2) deviations.
#include <algorithm>
#include <cmath>
#include <vector>

#include "kernels.h"
#include <splatwizard/vector_math.h>

namespace SW_ARCH {

using namespace sw_anchors;

namespace {

constexpr int64_t SCALES = 6;

}  // namespace

void sample_bits(const Sample& from, const SampleBits& to, const splatwizard::Parallel& parallel) {
  const int64_t f = from.features, k = from.offsets, numbers = f + SCALES + 3 * k, length = padded(numbers, LANES);
  const int64_t ends[] = {f, f + SCALES, numbers};
  parallel(from.count, 32, [&](int64_t begin, int64_t end) {
    // Of a row, padded with numbers that are certain: what the vectors read, then what they write.
    std::vector<float> scratch(10 * length, 1.f);
    const auto part = [&](int64_t i) { return scratch.data() + i * length; };
    float *const x = part(0), *const mean = part(1), *const scale = part(2), *const step = part(3),
          *const factor = part(4);
    float *const mass = part(5), *const by_x = part(6), *const by_scale = part(7), *const by_step = part(8),
          *const bits = part(9);
    for (int64_t row = begin; row < end; ++row) {
      std::copy_n(from.x + row * numbers, numbers, x);
      std::copy_n(from.mean + row * numbers, numbers, mean);
      std::copy_n(from.scale + row * numbers, numbers, scale);
      for (int64_t group = 0, i = 0; group < 3; ++group)
        for (; i < ends[group]; ++i) step[i] = from.steps[3 * row + group];
      std::fill_n(factor, f + SCALES, from.counted[row]);
      for (int64_t i = 0; i < 3 * k; ++i) factor[f + SCALES + i] = from.masks[row * k + i / 3];
      for (int64_t i = 0; i < length; i += LANES) {
        const Vec offset = load(x + i) - load(mean + i), away = magnitude(offset), half = all(0.5f) * load(step + i);
        const Vec raw = load(scale + i), least = all(from.smallest_scale);
        const Vec deviation = raw < least ? least : raw, narrow = all(0.70710678f) / deviation;
        const Vec near = (away - half) * narrow, far = (away + half) * narrow;
        const Vec p = all(0.5f) * (erfc(near) - erfc(far)), floor = all(from.smallest);
        const Vec bounded = p < floor ? floor : p;  // what is not a number stays so
        store(mass + i, bounded);
        // Below its floor a probability still has the gradient that raises it: that of bits that count is negative.
        const Vec slope = load(factor + i) * all(-1.4426950409f * 0.56418958355f) / bounded;  // 1 / ln 2, 1 / sqrt(pi)
        const Vec at_near = slope * exponential(-near * near), at_far = slope * exponential(-far * far);
        const Vec inner = (at_far - at_near) * narrow;
        store(by_x + i, offset > Vec{} ? inner : offset < Vec{} ? -inner : Vec{});
        store(by_scale + i, raw >= least ? (at_near * near - at_far * far) / deviation : Vec{});
        store(by_step + i, all(0.5f) * (at_near + at_far) * narrow);
      }
      for (int64_t i = 0; i < numbers; ++i) bits[i] = -std::log2(mass[i]);
      for (int64_t j = 0; j < k; ++j) {
        const float* own = bits + f + SCALES + 3 * j;
        to.masks[row * k + j] = own[0] + own[1] + own[2];
      }
      for (int64_t group = 0, i = 0; group < 3; ++group) {
        float sum = 0.f, slope = 0.f;
        for (; i < ends[group]; ++i) sum += factor[i] * bits[i], slope += by_step[i];
        to.bits[3 * row + group] = sum, to.steps[3 * row + group] = slope;
      }
      for (int64_t i = 0; i < numbers; ++i) to.x[row * numbers + i] = by_x[i], to.mean[row * numbers + i] = -by_x[i];
      std::copy_n(by_scale, numbers, to.scale + row * numbers);
    }
  });
}

}  // namespace SW_ARCH
