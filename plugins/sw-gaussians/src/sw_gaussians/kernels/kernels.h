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

// The cheapest neighbour of each of n rows of a [rows, 15] table along a curve.
struct MergePartnersArgs {
  const float* table;
  const float* sh;       // [rows, width], three of band 0 first
  const float* weights;  // [rows] or null
  const int64_t* order;  // [n] rows of the table
  int64_t n, width, window;
  uint32_t wave;
  float near;
  float* prices;  // [n, window] those of a place of the curve with the next ones
  float* best;
  int64_t* partner;  // its place
};

// Pairs of rows that merge in place: the first of each becomes the two.
struct MergePairsArgs {
  float *means, *scales, *quats, *opacities;  // [rows] of 3, 3, 4, 1
  float* sh;                                  // [rows, width]
  float* table;                               // [rows, 15]
  const int64_t* pairs;                       // [n, 2], no row twice
  int64_t n, width;
  float unit;
  const float* center;  // [3]
  bool widen;
};

}  // namespace splatwizard

#define SW_DECLARE_GAUSSIANS(arch)                                                                    \
  namespace arch {                                                                                    \
  void sparse_adam(const splatwizard::SparseAdamArgs& args, const splatwizard::Parallel& parallel);  \
  void merge_partners(const splatwizard::MergePartnersArgs& args, const splatwizard::Parallel& parallel); \
  void merge_pairs(const splatwizard::MergePairsArgs& args, const splatwizard::Parallel& parallel);  \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_GAUSSIANS)
