// The training kernels, declared once for every instruction set that they are compiled for.
#pragma once
#include <cstdint>

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

namespace splatwizard {

// Two images of `planes` planes (channels), row-major, and what is wanted of them.
struct PhotometricArgs {
  const float* x;       // [planes, height, width] the image that is trained
  const float* y;       // [planes, height, width] the picture
  int64_t planes, height, width;
  bool valid;           // SSIM only where the window lies inside the image; otherwise zero padding
  float l1_weight;      // d loss / d sum|x-y|
  float ssim_weight;    // d loss / d sum(ssim map)
  float* grad;          // [planes, height, width] d loss / d x, or null
  double* row_l1;       // [planes * height] sum |x-y| of each row
  double* row_ssim;     // [planes * height] sum of the SSIM map of each row
};

struct AdamArgs {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  int64_t count;
  float step_size;      // lr / (1 - beta1^t)
  float one_minus_beta1;
  float beta2;
  float one_minus_beta2;
  float inv_bias2;      // 1 / sqrt(1 - beta2^t)
  float eps;
};

}  // namespace splatwizard

#define SW_DECLARE_TRAINING(arch)                                                                     \
  namespace arch {                                                                                    \
  void photometric(const splatwizard::PhotometricArgs& args, const splatwizard::Parallel& parallel); \
  void adam(const splatwizard::AdamArgs& args, const splatwizard::Parallel& parallel);                \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_TRAINING)
