// The op for the bits of a sample of anchors, on the CPU; binding_rows.cpp defines it.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <torch/library.h>

#include <splatwizard/torch_parallel.h>

#include <vector>

#include "checked.h"
#include "kernels.h"

namespace {

using namespace sw_anchors;
using at::Tensor;

std::vector<Tensor> sample_bits(const Tensor& x, const Tensor& mean, const Tensor& scale, const Tensor& steps,
                                const Tensor& counted, const Tensor& masks, double p_min, double smallest_scale) {
  TORCH_CHECK(x.dim() == 2 && masks.dim() == 2, "sw_anchors: x must be [s,numbers], masks [s,k]");
  const int64_t s = x.size(0), k = masks.size(1), numbers = x.size(1);
  TORCH_CHECK(numbers >= 6 + 3 * k, "sw_anchors: ", numbers, " numbers are too few for ", k, " offsets");
  const auto real = x.options().requires_grad(false);
  std::vector<Tensor> found = {at::empty({s, 3}, real), at::empty({s, numbers}, real), at::empty({s, numbers}, real),
                               at::empty({s, numbers}, real), at::empty({s, 3}, real), at::empty({s, k}, real)};
  const auto at = [&](int i) { return found[i].data_ptr<float>(); };
  const Sample sample{s, int(numbers - 6 - 3 * k), int(k), floats(x, "x", {s, numbers}),
                      floats(mean, "mean", {s, numbers}), floats(scale, "scale", {s, numbers}),
                      floats(steps, "steps", {s, 3}), floats(counted, "counted", {s}), floats(masks, "masks", {s, k}),
                      float(p_min), float(smallest_scale)};
  SW_SELECT(sample_bits)(sample, {at(0), at(1), at(2), at(3), at(4), at(5)}, splatwizard::torch_parallel());
  return found;
}

}  // namespace

TORCH_LIBRARY_IMPL(sw_anchors, CPU, m) { m.impl("sample_bits", sample_bits); }
