// What the CUDA bindings share: the arguments of the ops, checked, as the kernels take them.
#pragma once

#include <ATen/core/Tensor.h>

#include <algorithm>
#include <array>
#include <cstdlib>
#include <initializer_list>
#include <limits>
#include <optional>

#include "../call.h"
#include "../flags.h"

namespace sw {

using at::Tensor;
using OptionalTensor = std::optional<Tensor>;

template <class S>
S* data(const Tensor& t) {
  return t.defined() && t.numel() > 0 ? static_cast<S*>(t.data_ptr()) : nullptr;
}
template <class S>
const S* data(const OptionalTensor& t) {
  return t.has_value() ? data<S>(*t) : nullptr;
}

// Pairs of a splat and a tile that a call may have; a file of a kilobyte can ask for any number of them. 2^27 are four
// times those of the largest real scenes.
inline int64_t most_pairs() {
  const char* text = std::getenv("SPLATWIZARD_MAX_TILE_PAIRS");
  const int64_t asked = text == nullptr ? 0 : std::atoll(text);
  return std::min<int64_t>(asked > 0 ? asked : int64_t(1) << 27, std::numeric_limits<int32_t>::max());
}

// `memory`: what a pair takes on the device.
inline void check_pairs(int64_t count, int64_t most, const char* memory) {
  TORCH_CHECK(count <= most, "sw_rasterizers: ", count, " splat-tile pairs are more than ", most,
              ": draw fewer Gaussians or a smaller image, or set SPLATWIZARD_MAX_TILE_PAIRS (", memory, ")");
}

struct Inputs {
  const Tensor &means, &opacities;
  const OptionalTensor &scales, &quats, &cov3d, &sh, &sh_dc, &sh_rest, &colors, &features, &visible, &background;
  int64_t sh_degree;
  double scale_modifier, eps2d;
  int64_t flags;
  int64_t scale_columns = 3;  // 2: surfels
  OptionalTensor scale_factors = {}, geom_indices = {};

  void check() const {
    check_geometry();
    const int64_t n = means.size(0);
    check_shape("opacities", opacities, {n});
    check_shape("sh", sh, {n, -1, 3});
    check_shape("sh_dc", sh_dc, {n, 1, 3});
    check_shape("sh_rest", sh_rest, {n, -1, 3});
    check_shape("colors", colors, {n, -1});
    check_shape("features", features, {n, -1});
    TORCH_CHECK(int(sh.has_value()) + int(sh_dc.has_value()) + int(colors.has_value()) == 1,
                "sw_rasterizers: exactly one of sh, sh_dc and colors is needed");
    const int64_t basis = (sh_degree + 1) * (sh_degree + 1);
    const int64_t stored = sh.has_value() ? sh->size(1) : 1 + (sh_rest.has_value() ? sh_rest->size(1) : 0);
    TORCH_CHECK(colors.has_value() || (sh_degree >= 0 && sh_degree <= 3 && basis <= stored),
                "sw_rasterizers: SH degree ", sh_degree, " needs ", basis, " coefficients, got ", stored);
    for (const OptionalTensor* t : {&sh, &sh_dc, &sh_rest, &colors, &features, &background})
      TORCH_CHECK(!t->has_value() || (*t)->scalar_type() == means.scalar_type(),
                  "sw_rasterizers: all tensors must have the dtype of means, ", means.scalar_type());
    TORCH_CHECK(channels().total() > 0, "sw_rasterizers: there is no channel to draw");
    TORCH_CHECK(opacities.scalar_type() == means.scalar_type(),
                "sw_rasterizers: opacities must have the dtype of means, ", means.scalar_type());
  }

  void check_shape(const char* name, const OptionalTensor& t, std::initializer_list<int64_t> shape) const {
    if (!t.has_value()) return;
    bool fits = t->is_contiguous() && t->dim() == int64_t(shape.size());
    for (int64_t d = 0; fits && d < t->dim(); ++d) fits = shape.begin()[d] < 0 || t->size(d) == shape.begin()[d];
    TORCH_CHECK(fits, "sw_rasterizers: ", name, " must be a contiguous tensor of shape ",
                c10::IntArrayRef(shape.begin(), shape.size()), " (-1: any), got ", t->sizes());
    TORCH_CHECK(t->device() == means.device(), "sw_rasterizers: ", name, " is on ", t->device(), ", means on ",
                means.device(), ": all tensors must be on one device");
  }

  // What visible_radii reads too.
  void check_geometry() const {
    const auto type = means.scalar_type();
    TORCH_CHECK(type == at::kFloat || type == at::kDouble, "sw_rasterizers: means must be float32 or float64, got ",
                type);
    const int64_t n = means.size(0);
    TORCH_CHECK(n < std::numeric_limits<int32_t>::max(), "sw_rasterizers: more than 2^31 - 1 Gaussians");
    check_shape("means", means, {n, 3});
    const bool shared = geom_indices.has_value() && scales.has_value() && scales->dim() == 2;
    const int64_t shapes = shared ? scales->size(0) : n;
    TORCH_CHECK(shapes < std::numeric_limits<int32_t>::max(), "sw_rasterizers: more than 2^31 - 1 shapes");
    check_shape("scales", scales, {shapes, scale_columns});
    check_shape("quats", quats, {shapes, 4});
    check_shape("scale_factors", scale_factors, {n});
    check_shape("geom_indices", geom_indices, {n});
    TORCH_CHECK(!geom_indices.has_value() || geom_indices->scalar_type() == at::kLong,
                "sw_rasterizers: geom_indices must be int64");
    TORCH_CHECK(!cov3d.has_value() || (!geom_indices.has_value() && !scale_factors.has_value()),
                "sw_rasterizers: cov3d excludes geom_indices and scale_factors");
    check_shape("cov3d", cov3d, {n, 6});
    check_shape("visible", visible, {n});
    TORCH_CHECK(!visible.has_value() || visible->scalar_type() == at::kByte, "sw_rasterizers: visible must be uint8");
    TORCH_CHECK(cov3d.has_value() != (scales.has_value() && quats.has_value()),
                "sw_rasterizers: either scales and quats or cov3d is needed");
    for (const OptionalTensor* t : {&scales, &quats, &cov3d, &scale_factors})
      TORCH_CHECK(!t->has_value() || (*t)->scalar_type() == type,
                  "sw_rasterizers: all tensors must have the dtype of means, ", type);
  }

  template <class S>
  sw::Gaussians<S> gaussians() const {
    sw::Gaussians<S> g;
    g.count = means.size(0);
    g.means = data<S>(means), g.opacities = data<S>(opacities);
    g.scales = data<S>(scales), g.quats = data<S>(quats), g.cov3d = data<S>(cov3d);
    if (sh.has_value()) {
      g.sh_dc = data<S>(sh), g.sh_rest = g.sh_dc + 3;
      g.sh_dc_stride = g.sh_rest_stride = 3 * sh->size(1);
    } else if (sh_dc.has_value()) {
      g.sh_dc = data<S>(sh_dc), g.sh_dc_stride = 3;
      if (sh_rest.has_value()) g.sh_rest = data<S>(sh_rest), g.sh_rest_stride = 3 * sh_rest->size(1);
    }
    g.sh_degree = int(sh_degree);
    g.colors = data<S>(colors);
    g.color_channels = colors.has_value() ? int(colors->size(1)) : 3;
    g.features = data<S>(features);
    g.feature_channels = features.has_value() ? int(features->size(1)) : 0;
    g.visible = data<uint8_t>(visible);
    g.shape_rows = data<int64_t>(geom_indices), g.scale_factors = data<S>(scale_factors);
    g.shapes = scales.has_value() ? scales->size(0) : 0;
    return g;
  }

  sw::Settings settings() const {
    sw::Settings s;
    s.scale_modifier = scale_modifier, s.eps2d = eps2d;
    s.antialias = flags & kAntialias, s.clamp_color = flags & kClampColor, s.tight = flags & kTight;
    s.pass_clamp = flags & kPassClamp, s.original_jacobian = flags & kOriginalJacobian;
    s.inverse_depth = flags & kInverseDepth;
    s.accumulated_depth = flags & kAccumulatedDepth, s.median_depth = flags & kMedianDepth;
    s.detach_features = flags & kDetachFeatures, s.absgrad = flags & kAbsgrad;
    s.fragments = flags & kFragments;
    s.most_pairs = most_pairs();
    return s;
  }

  sw::Channels channels() const {
    return {colors.has_value() ? int(colors->size(1)) : 3, (flags & kInverseDepth) != 0,
            (flags & kAccumulatedDepth) != 0, features.has_value() ? int(features->size(1)) : 0};
  }

  // Whether three colours in the record are all there is: the fast kernels.
  bool plain() const { return channels().total() == 3 && channels().colors == 3 && !(flags & kMedianDepth); }
};

// clang-format off
enum Wanted {  // order of the gradients asked for and returned
  kWantMeans, kWantOpacities, kWantScales, kWantQuats, kWantCov3d, kWantSh, kWantShDc, kWantShRest,
  kWantColors, kWantFeatures, kWantScaleFactors, kWantGrad2d, kWantAbsgrad2d, kWantedCount
};
// clang-format on

}  // namespace sw
