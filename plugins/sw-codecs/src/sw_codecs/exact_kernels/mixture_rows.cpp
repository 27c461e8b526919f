// Windows, tables and weights of numbers under mixtures (sw_codecs.entropy.conditional_mixture), from outputs of
// networks: rules 3 to 5 of the exact mixture.
#include <atomic>

#include "lattice.h"
#include "mixtures.h"

namespace SW_ARCH {

using namespace splatwizard;

namespace {

// One number, given integer parts and tables of both Gaussians; the index of its width.
inline int32_t number_of(const MixtureRowsArgs& a, int64_t i, int64_t logit, const int32_t* centre,
                         const int16_t* number) {
  // sigmoid(d) = (1 + tanh(d / 2)) / 2: the table of step multipliers has it.
  const int64_t j = ((logit >> 1) + (1 << 15)) >> 9;
  const int64_t share = (a.multipliers[j < 0 ? 0 : j > 127 ? 127 : j] + 16) >> 5;
  const auto weight = static_cast<int32_t>(share < 2 ? 2 : share > 254 ? 254 : share);
  const int64_t middle = weight >= 128 ? centre[0] : centre[1];
  int64_t reach = 0;
  for (int c = 0; c < 2; ++c) {
    const int64_t shift = middle - centre[c], over = a.radius[number[c]] + (shift < 0 ? -shift : shift);
    reach = over > reach ? over : reach;
    a.shift[2 * i + c] = static_cast<int32_t>(shift < -MIXTURE_FAR ? -MIXTURE_FAR : shift > MIXTURE_FAR ? MIXTURE_FAR : shift);
    a.number[2 * i + c] = number[c];
  }
  int32_t width = 0;
  while (width < a.widths - 1 && a.half_widths[width] < reach) ++width;
  a.centre[i] = static_cast<int32_t>(middle);
  a.width[i] = static_cast<int32_t>(a.half_widths[width]);
  a.weight[i] = weight;
  return width;
}

}  // namespace

int32_t mixture_rows(const MixtureRowsArgs& a, const Parallel& parallel) {
  const Levels levels(a.thresholds);
  const int64_t n = a.rows * a.columns;
  Scratch<uint8_t> kind(n);
  std::atomic<int32_t> status{FINE};
  parallel(a.rows, 256, [&](int64_t begin, int64_t end) {
    double mean[COLUMNS], scale[COLUMNS];
    int32_t centre[2][COLUMNS], found = FINE;
    int16_t number[2][COLUMNS];
    for (int64_t row = begin; row < end && found == FINE; ++row) {
      const int64_t m = a.step[row * a.stride[5]];
      if (m < 64 || m > 16384) {
        found = PARAMETER_WRONG;
        break;
      }
      for (int64_t c = 0; c < a.columns && found == FINE; c += COLUMNS) {
        const int64_t count = a.columns - c < COLUMNS ? a.columns - c : COLUMNS;
        for (int g = 0; g < 2; ++g) {
          if (!take_integers(a.mean[g] + row * a.stride[2 * g] + c, count, mean) ||
              !take_integers(a.scale[g] + row * a.stride[2 * g + 1] + c, count, scale))
            found = PARAMETER_WRONG;
          else if (columns_of(levels, mean, scale, m, count, centre[g], number[g]))
            found = BEYOND_LIMIT;
        }
        if (found != FINE) break;
        const int64_t* logit = a.logit + row * a.stride[4] + c;
        for (int64_t i = 0; i < count; ++i) {
          const int32_t centres[2] = {centre[0][i], centre[1][i]};
          const int16_t numbers[2] = {number[0][i], number[1][i]};
          const int64_t at = row * a.columns + c + i;
          kind[at] = static_cast<uint8_t>(number_of(a, at, logit[i], centres, numbers));
        }
      }
    }
    int32_t fine = FINE;
    if (found != FINE) status.compare_exchange_strong(fine, found);
  });
  if (status != FINE) return status;
  int64_t next[256] = {};
  for (int64_t i = 0; i < n; ++i) ++next[kind[i]];
  for (int64_t k = 0, at = 0; k < 256; ++k) {
    const int64_t count = next[k];
    next[k] = at;
    at += count;
  }
  for (int64_t i = 0; i < n; ++i) a.order[next[kind[i]]++] = static_cast<int32_t>(i);
  return FINE;
}

}  // namespace SW_ARCH
