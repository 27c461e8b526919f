// The arguments of the ops that spawn Gaussians, checked, and their memory.
#pragma once

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>

#include <optional>
#include <vector>

#include "spawn.h"

namespace sw_anchors {

using at::Tensor;

struct Arguments {
  const Tensor &alpha, &geometry, &color, &positions, &offsets, &scales;
  const std::optional<Tensor>& masks;
  const Tensor& drawn;

  Anchors checked() const {
    TORCH_CHECK(alpha.dim() == 2 && alpha.size(1) > 0, "sw_anchors: alpha must be [n,k], got ", alpha.sizes());
    const int64_t n = alpha.size(0), k = alpha.size(1);
    check(alpha, "alpha", {n, k}, true);
    check(geometry, "geometry", {n, kGeometry * k}, true);
    check(color, "color", {n, 3 * k}, true);
    check(positions, "positions", {n, 3}, true);
    check(offsets, "offsets", {n, k, 3}, false);
    check(scales, "scales", {n, 6}, false);
    TORCH_CHECK(n == 0 || (offsets.stride(2) == 1 && offsets.stride(1) == 3 && scales.stride(1) == 1),
                "sw_anchors: offsets and scales must have rows without gaps");
    if (masks.has_value()) check(*masks, "masks", {n, k}, true);
    TORCH_CHECK(drawn.dim() == 1 && drawn.scalar_type() == at::kLong && drawn.is_contiguous() &&
                    drawn.device() == alpha.device(),
                "sw_anchors: drawn must be a contiguous int64 vector on ", alpha.device());
    return {n, k, alpha.const_data_ptr<float>(), geometry.const_data_ptr<float>(), color.const_data_ptr<float>(),
            positions.const_data_ptr<float>(), offsets.const_data_ptr<float>(), scales.const_data_ptr<float>(),
            masks.has_value() ? masks->const_data_ptr<float>() : nullptr, n > 0 ? offsets.stride(0) : 0,
            n > 0 ? scales.stride(0) : 0, drawn.const_data_ptr<int64_t>(), drawn.size(0)};
  }

  void check(const Tensor& t, const char* name, at::IntArrayRef shape, bool contiguous) const {
    TORCH_CHECK(t.scalar_type() == at::kFloat && t.device() == alpha.device() && t.sizes() == shape &&
                    (!contiguous || t.is_contiguous()),
                "sw_anchors: ", name, " must be float32 ", shape, " on ", alpha.device(), ", got ", t.toString(), " ",
                t.sizes(), " on ", t.device());
  }
};

// Means [m,3], opacities [m], scales [m,3], quaternions [m,4], colours [m,3], and where they are.
struct Spawned {
  std::vector<Tensor> tensors;
  Gaussians at;
  Spawned(int64_t m, const Tensor& like) {
    const auto real = like.options().requires_grad(false);
    tensors = {at::empty({m, 3}, real), at::empty({m}, real), at::empty({m, 3}, real), at::empty({m, 4}, real),
               at::empty({m, 3}, real)};
    at = gaussians_of(tensors);
  }
  static Gaussians gaussians_of(const std::vector<Tensor>& t) {
    return {t[0].data_ptr<float>(), t[1].data_ptr<float>(), t[2].data_ptr<float>(), t[3].data_ptr<float>(),
            t[4].data_ptr<float>()};
  }
};

// The gradients by the Gaussians, checked.
inline Gaussians slopes_of(const std::vector<Tensor>& slopes, const Arguments& from) {
  const int64_t m = from.drawn.size(0);
  TORCH_CHECK(slopes.size() == 5, "sw_anchors: five gradients are needed");
  const char* names[5] = {"gradient of means", "gradient of opacities", "gradient of scales", "gradient of quats",
                          "gradient of colors"};
  for (int i = 0; i < 5; ++i) {
    if (i == 1)
      from.check(slopes[i], names[i], {m}, true);
    else
      from.check(slopes[i], names[i], {m, i == 3 ? 4 : 3}, true);
  }
  return Spawned::gaussians_of(slopes);
}

// Zeros for alpha, geometry, color, offsets, scales, masks and positions (the last two [0] where not wanted), in one
// allocation: cleared one by one they would be seven launches.
struct Dense {
  std::vector<Tensor> tensors;
  Gradients at;
  Dense(const Anchors& from, bool with_masks, bool with_positions, const Tensor& like) {
    const int64_t n = from.n, k = from.k;
    const std::vector<std::vector<int64_t>> shapes = {
        {n, k}, {n, kGeometry * k}, {n, 3 * k}, {n, k, 3}, {n, 6}, {with_masks ? n : 0, k}, {with_positions ? n : 0, 3}};
    std::vector<int64_t> starts;
    int64_t total = 0;
    for (const auto& shape : shapes) {
      starts.push_back(total);
      int64_t count = 1;
      for (const int64_t size : shape) count *= size;
      total += (count + 31) / 32 * 32;
    }
    const Tensor all = at::zeros({total}, like.options().requires_grad(false));
    float* base = all.data_ptr<float>();
    for (size_t i = 0; i < shapes.size(); ++i) {
      int64_t count = 1;
      for (const int64_t size : shapes[i]) count *= size;
      tensors.push_back(all.narrow(0, starts[i], count).view(shapes[i]));
    }
    at = {base, base + starts[1], base + starts[2], base + starts[3], base + starts[4],
          with_masks ? base + starts[5] : nullptr, with_positions ? base + starts[6] : nullptr};
  }
};

}  // namespace sw_anchors
