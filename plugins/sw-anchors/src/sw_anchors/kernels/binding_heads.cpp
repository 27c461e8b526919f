// Registers the ops of anchors whose networks and Gaussians are one pass, on the CPU.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <splatwizard/torch_parallel.h>

#include "binding.h"
#include "kernels.h"

namespace {

using namespace sw_anchors;

// Twelve tensors: weight and bias of the first and of the last layer, of each network.
Heads heads_of(const std::vector<Tensor>& parameters, const Tensor& features, int64_t k) {
  TORCH_CHECK(parameters.size() == 4 * kHeads && parameters[0].dim() == 2 && features.dim() == 2,
              "sw_anchors: three networks of two layers are needed");
  Heads heads{};
  heads.features = features.size(1), heads.hidden = parameters[0].size(0);
  const auto at = [&](int64_t i, at::IntArrayRef shape) {
    const Tensor& t = parameters[i];
    TORCH_CHECK(t.scalar_type() == at::kFloat && t.is_cpu() && t.is_contiguous() && t.sizes() == shape,
                "sw_anchors: parameter ", i, " of the networks must be contiguous float32 ", shape, ", got ",
                t.toString(), " ", t.sizes());
    return t.const_data_ptr<float>();
  };
  for (int h = 0; h < kHeads; ++h) {
    heads.first[h] = at(4 * h, {heads.hidden, heads.features + 4});
    heads.first_bias[h] = at(4 * h + 1, {heads.hidden});
    heads.last[h] = at(4 * h + 2, {kOutputs[h] * k, heads.hidden});
    heads.last_bias[h] = at(4 * h + 3, {kOutputs[h] * k});
  }
  return heads;
}

const float* rows(const Tensor& t, const char* name, int64_t n, at::IntArrayRef tail, bool gaps) {
  bool fits = t.scalar_type() == at::kFloat && t.is_cpu() && t.dim() == int64_t(1 + tail.size()) && t.size(0) == n &&
              t.sizes().slice(1) == tail;
  int64_t stride = 1;
  for (int64_t i = t.dim() - 1; fits && n > 0 && i > 0; --i) fits = t.stride(i) == stride, stride *= t.size(i);
  fits = fits && (n == 0 || gaps || t.stride(0) == stride);
  TORCH_CHECK(fits, "sw_anchors: ", name, " must be float32 rows ", tail, " of ", n, " anchors, got ", t.toString(),
              " ", t.sizes());
  return t.const_data_ptr<float>();
}

struct Inputs {
  const Tensor &center, &positions, &features, &offsets, &scales;
  const std::optional<Tensor>& masks;

  Anchors anchors() const {
    TORCH_CHECK(offsets.dim() == 3 && offsets.size(1) > 0, "sw_anchors: offsets must be [n,k,3]");
    const int64_t n = offsets.size(0), k = offsets.size(1);
    Anchors from{};
    from.n = n, from.k = k, from.compact = true;
    from.positions = rows(positions, "positions", n, {3}, false);
    from.offsets = rows(offsets, "offsets", n, {k, 3}, true);
    from.scales = rows(scales, "scales", n, {6}, true);
    from.masks = masks.has_value() ? rows(*masks, "masks", n, {k}, false) : nullptr;
    from.offset_row = n > 0 ? offsets.stride(0) : 0, from.scale_row = n > 0 ? scales.stride(0) : 0;
    return from;
  }

  Seen seen() const {
    return {rows(center, "the camera's centre", 3, {}, false),
            rows(features, "features", offsets.size(0), {features.size(1)}, true),
            features.size(0) > 0 ? features.stride(0) : 0};
  }
};

// Means, opacities, scales, quaternions and colours of the Gaussians of opacity > 0; opacities [n,k] of all and the same
// before masks; which were drawn; hidden layers and raw outputs for the gradient.
std::vector<Tensor> heads(const Tensor& center, const Tensor& positions, const Tensor& features, const Tensor& offsets,
                          const Tensor& scales, const std::optional<Tensor>& masks,
                          const std::vector<Tensor>& parameters) {
  const Inputs given{center, positions, features, offsets, scales, masks};
  Anchors from = given.anchors();
  const Heads by = heads_of(parameters, features, from.k);
  const Seen seen = given.seen();
  const auto real = features.options().requires_grad(false);
  const Tensor hidden = at::empty({SW_SELECT(heads_rows)(from.n), SW_SELECT(heads_width)(by)}, real);
  const Tensor alpha = at::empty({from.n, from.k}, real), opacities = at::empty({from.n, from.k}, real);
  const auto parallel = splatwizard::torch_parallel();
  SW_SELECT(heads_opacities)(from, seen, by, hidden.data_ptr<float>(), alpha.data_ptr<float>(),
                             opacities.data_ptr<float>(), parallel);
  const float* const all = opacities.const_data_ptr<float>();
  for (int64_t i = 0; i < from.n * from.k; ++i) from.count += all[i] > 0.f;
  const Tensor drawn = at::empty({from.count}, real.dtype(at::kLong));
  int64_t* to = drawn.data_ptr<int64_t>();
  for (int64_t i = 0; i < from.n * from.k; ++i)
    if (all[i] > 0.f) *to++ = i;
  const Tensor geometry = at::empty({from.count, kGeometry}, real), color = at::empty({from.count, 3}, real);
  from.alpha = alpha.const_data_ptr<float>(), from.drawn = drawn.const_data_ptr<int64_t>();
  from.geometry = geometry.const_data_ptr<float>(), from.color = color.const_data_ptr<float>();
  Spawned found(from.count, features);
  SW_SELECT(heads_spawn)(from, by, hidden.const_data_ptr<float>(), geometry.data_ptr<float>(),
                         color.data_ptr<float>(), found.at, parallel);
  for (const Tensor& more : {opacities, alpha, drawn, hidden, geometry, color}) found.tensors.push_back(more);
  return found.tensors;
}

// Gradients of features, offsets, scales, masks ([0] without), then of the twelve parameters. `saved`: alpha, drawn,
// hidden, geometry, color.
std::vector<Tensor> heads_backward(const Tensor& center, const Tensor& positions, const Tensor& features,
                                   const Tensor& offsets, const Tensor& scales, const std::optional<Tensor>& masks,
                                   const std::vector<Tensor>& parameters, const std::vector<Tensor>& saved,
                                   const std::vector<Tensor>& slopes) {
  const Inputs given{center, positions, features, offsets, scales, masks};
  Anchors from = given.anchors();
  const Heads by = heads_of(parameters, features, from.k);
  const int64_t n = from.n, k = from.k;
  TORCH_CHECK(saved.size() == 5 && saved[1].dim() == 1 && saved[1].scalar_type() == at::kLong &&
                  saved[1].is_contiguous(),
              "sw_anchors: what the forward pass saved is needed");
  const int64_t width = SW_SELECT(heads_width)(by), m = saved[1].size(0);
  from.alpha = rows(saved[0], "alpha", n, {k}, false);
  from.drawn = saved[1].const_data_ptr<int64_t>(), from.count = m;
  const float* hidden = rows(saved[2], "hidden layers", SW_SELECT(heads_rows)(n), {width}, false);
  from.geometry = rows(saved[3], "geometry", m, {kGeometry}, false), from.color = rows(saved[4], "color", m, {3}, false);
  TORCH_CHECK(slopes.size() == 5, "sw_anchors: five gradients are needed");
  for (int i = 0; i < 5; ++i) {
    const std::vector<int64_t> tail = i == 1 ? std::vector<int64_t>{} : std::vector<int64_t>{i == 3 ? 4 : 3};
    rows(slopes[i], "a gradient of Gaussians", m, tail, false);
  }
  const auto real = features.options().requires_grad(false);
  std::vector<Tensor> found = {at::empty({n, by.features}, real), at::zeros({n, k, 3}, real), at::zeros({n, 6}, real),
                               at::zeros({masks.has_value() ? n : 0, k}, real)};
  HeadGradients to_heads{};
  for (int i = 0; i < 4 * kHeads; ++i) {
    found.push_back(at::empty(parameters[i].sizes(), real));
    float* const place = found.back().data_ptr<float>();
    float** const members[4] = {to_heads.first, to_heads.first_bias, to_heads.last, to_heads.last_bias};
    members[i % 4][i / 4] = place;
  }
  const Tensor to_alpha = at::empty({n, k}, real), to_geometry = at::empty({m, kGeometry}, real),
               to_color = at::empty({m, 3}, real);
  const Gradients to{to_alpha.data_ptr<float>(), to_geometry.data_ptr<float>(), to_color.data_ptr<float>(),
                     found[1].data_ptr<float>(), found[2].data_ptr<float>(),
                     masks.has_value() ? found[3].data_ptr<float>() : nullptr, nullptr};
  SW_SELECT(heads_backward)(from, given.seen(), by, hidden, Spawned::gaussians_of(slopes), to,
                            found[0].data_ptr<float>(), to_heads, splatwizard::torch_parallel());
  return found;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_anchors, m) {
  m.def("heads(Tensor center, Tensor positions, Tensor features, Tensor offsets, Tensor scales, Tensor? masks,"
        " Tensor[] parameters) -> Tensor[]");
  m.def("heads_backward(Tensor center, Tensor positions, Tensor features, Tensor offsets, Tensor scales,"
        " Tensor? masks, Tensor[] parameters, Tensor[] saved, Tensor[] slopes) -> Tensor[]");
  m.impl("heads", c10::DispatchKey::CPU, TORCH_FN(heads));
  m.impl("heads_backward", c10::DispatchKey::CPU, TORCH_FN(heads_backward));
}
