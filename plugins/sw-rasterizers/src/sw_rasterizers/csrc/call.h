// What one call of the rasterizer is about: the Gaussians, how they are drawn, where their gradients go. The same
// for the CPU and the CUDA kernels; all pointers are of one device.
#pragma once

#include <cstdint>

#include "common.h"

namespace splatwizard {
struct Parallel;
}

namespace sw {

template <class S>
struct Gaussians {
  int64_t count = 0;
  const S* means = nullptr;
  const S* opacities = nullptr;
  const S* scales = nullptr;  // with quats, or cov3d alone
  const S* quats = nullptr;
  const S* cov3d = nullptr;
  const S* sh_dc = nullptr;  // row i at sh_dc + i * sh_dc_stride; the rest likewise: dense and split are one case
  const S* sh_rest = nullptr;
  int64_t sh_dc_stride = 0, sh_rest_stride = 0;
  int sh_degree = 0;          // active
  const S* colors = nullptr;  // instead of SH
  int color_channels = 3;
  const S* features = nullptr;
  int feature_channels = 0;
  const uint8_t* visible = nullptr;
  const int64_t* shape_rows = nullptr;   // [N] row of scales and quats, each below `shapes`; null: its own
  const S* scale_factors = nullptr;      // [N] multiplies the scales, or null
  int64_t shapes = 0;                    // rows of scales and quats

  SW_HD int64_t shape_of(int64_t n) const { return shape_rows != nullptr ? shape_rows[n] : n; }
};

struct Settings {
  double scale_modifier = 1, eps2d = 0.3;
  bool antialias = false, clamp_color = true;
  bool tight = true;               // exact tile coverage, else 3DGS' squares
  bool pass_clamp = false;         // gradient passes through the clamp of alpha
  bool original_jacobian = false;  // gradient of the Jacobian's clamp as in the original kernels
  bool inverse_depth = false, accumulated_depth = false, median_depth = false;
  bool detach_features = false;
  bool absgrad = false;    // two more sums a pair: |dL/du|, |dL/dv|
  bool fragments = false;  // with absgrad, those two are the sum of (o dL/do)^2 over the fragments, and their number
  const splatwizard::Parallel* parallel = nullptr;  // threads of the CPU; null: the caller's
  int64_t most_pairs = 0;  // of CUDA: (splat, tile) pairs that a call may have; beyond, none are listed
};

// Channels of the composited image: colours, then inverse depth, accumulated depth, then features.
struct Channels {
  int colors, inverse, accumulated, features;
  SW_HD int total() const { return colors + inverse + accumulated + features; }
};

template <class S>
struct Gradients {  // null: not asked for
  S *means, *opacities, *scales, *quats, *cov3d, *sh_dc, *sh_rest, *colors, *features, *scale_factors;
  int64_t sh_dc_stride, sh_rest_stride;
  S *grad2d, *absgrad2d;  // [N][2], NDC units; with `fragments` the second holds their sums as they are
  S* shape_sums;          // [shape_groups(N, shapes)][shapes][kShapeSums], on the CPU, where shapes are shared
};

// Gradients of shared shapes on the CPU: each group of Gaussians, one after the other in index order, adds to sums of
// its own, and the sums are added in the order of the groups. The number of groups follows from sizes alone, so that
// the result does not depend on threads; they take 14 bytes a Gaussian, or four times the table where that is more.
constexpr int kShapeSums = 7;  // scales, quaternion
inline int64_t shape_groups(int64_t gaussians, int64_t shapes) {
  const int64_t groups = gaussians / (2 * (shapes > 0 ? shapes : 1));
  return groups < 4 ? 4 : groups > 64 ? 64 : groups;
}

}  // namespace sw
