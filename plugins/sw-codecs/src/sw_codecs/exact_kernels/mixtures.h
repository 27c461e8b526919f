// Numbers under mixtures of two shipped tables, in one stream (sw_codecs.entropy.conditional_mixture).
#pragma once
#include "kernels.h"

namespace splatwizard {

struct MixtureArgs {
  const double* below;    // sums of the counts before each entry -R .. R of a table, and of all of them; back to back
  const double* escape;   // [512] count of the escape
  const int32_t* first;   // [512] where the sums of a table begin
  const int32_t* radius;  // [512] R
  const int32_t* order;   // [n] rows in the order of coding
  const int32_t* width;   // [n] W: a window has the entries 0 .. 2 W, and the escape
  const int32_t* shift;   // [n, 2] centre of the window less that of each Gaussian
  const int16_t* number;  // [n, 2] tables
  const int32_t* weight;  // [n] of the first Gaussian, of 256
  int64_t n;
};

constexpr int64_t MIXTURE_FAR = 1 << 16;  // no table reaches as far from its middle

// Numbers [rows, columns], and what MixtureArgs has of them.
struct MixtureRowsArgs {
  const int64_t *mean[2], *scale[2], *logit, *step;
  int64_t stride[6];  // from row to row, of mean, scale, second mean, second scale, logit, step
  int64_t rows, columns;
  const int64_t* multipliers;  // [128]
  const int64_t* thresholds;   // [63]
  const int32_t* radius;       // [512]
  const int64_t* half_widths;  // [widths] ascending
  int64_t widths;
  int32_t *centre, *width, *order, *shift, *weight;
  int16_t* number;
};

}  // namespace splatwizard

#define SW_DECLARE_MIXTURES(arch)                                                                                  \
  namespace arch {                                                                                                 \
  int32_t decode_mixtures(const splatwizard::MixtureArgs&, const uint8_t* words, int64_t bytes, int32_t* entries); \
  int32_t mixture_rows(const splatwizard::MixtureRowsArgs&, const splatwizard::Parallel&);                         \
  int64_t encode_mixtures(const splatwizard::MixtureArgs&, const int32_t* entries, uint8_t* words);                \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_MIXTURES)
