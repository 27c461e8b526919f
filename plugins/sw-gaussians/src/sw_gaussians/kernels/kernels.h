// The kernels of training Gaussians, declared once for every instruction set that they are compiled for.
#pragma once
#include <cstdint>

#include <splatwizard/dispatch.h>
#include <splatwizard/parallel.h>

namespace splatwizard {

// Adam of the marked rows of a [rows, width] parameter.
struct SparseAdamArgs {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  const bool* mask;  // [rows] which rows are updated
  int64_t rows, width;
  float lr;
  float one_minus_beta1;
  float beta2;
  float one_minus_beta2;
  float eps;
};

}  // namespace splatwizard

#define SW_DECLARE_GAUSSIANS(arch)                                                                    \
  namespace arch {                                                                                    \
  void sparse_adam(const splatwizard::SparseAdamArgs& args, const splatwizard::Parallel& parallel);  \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_GAUSSIANS)
