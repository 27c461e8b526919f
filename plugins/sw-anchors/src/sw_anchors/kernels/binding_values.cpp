// Registers the ops of noisy values of anchors, on the CPU.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <splatwizard/torch_parallel.h>

#include <optional>
#include <vector>

#include "checked.h"
#include "kernels.h"

namespace {

using namespace sw_anchors;
using at::Tensor;

// Ascending, if so asked; each within 0 .. limit - 1.
const int64_t* places(const Tensor& t, const char* name, int64_t limit, bool ascending) {
  TORCH_CHECK(t.dim() == 1 && t.scalar_type() == at::kLong && t.is_cpu() && t.is_contiguous(), "sw_anchors: ", name,
              " must be a contiguous int64 vector on the CPU");
  const int64_t* p = t.const_data_ptr<int64_t>();
  for (int64_t i = 0; i < t.size(0); ++i)
    TORCH_CHECK(p[i] >= 0 && p[i] < limit && (!ascending || i == 0 || p[i] > p[i - 1]), "sw_anchors: ", name, "[", i,
                "] is ", p[i], " of ", limit);
  return p;
}

Rows rows_of(const Tensor& rows, const std::vector<Tensor>& tables, const std::optional<Tensor>& weights,
             double threshold, const std::optional<Tensor>& steps, const std::optional<Tensor>& uniform,
             const Tensor& drawn) {
  TORCH_CHECK(tables.size() == 4 && tables[0].dim() == 2 && tables[3].dim() == 2,
              "sw_anchors: features, log scales, offsets and mask logits are needed");
  Rows from{};
  const int64_t total = tables[0].size(0);
  from.count = rows.size(0), from.features = tables[0].size(1), from.k = tables[3].size(1);
  const int64_t width = from.features + 6 + 3 * from.k;
  from.rows = places(rows, "rows", total, false);
  from.of_features = floats(tables[0], "features", {total, from.features});
  from.log_scales = floats(tables[1], "log scales", {total, 6});
  from.of_offsets = floats(tables[2], "offsets", {total, from.k, 3});
  from.mask_logits = floats(tables[3], "mask logits", {total, from.k});
  from.mask_weights = weights.has_value() ? floats(*weights, "mask weights", {total, 1}) : nullptr;
  from.threshold = float(threshold);
  TORCH_CHECK(steps.has_value() == uniform.has_value(), "sw_anchors: noise has steps and draws");
  if (steps.has_value()) {
    from.step_row = steps->dim() == 2 ? kGroups : 0;
    from.steps = steps->dim() == 2 ? floats(*steps, "steps", {from.count, kGroups}) : floats(*steps, "steps", {kGroups});
    from.uniform = floats(*uniform, "draws", {from.count, width});
  }
  from.drawn = places(drawn, "drawn", from.count, true), from.samples = drawn.size(0);
  return from;
}

// Features, scales, offsets [.,k,3] and masks of the rows; all numbers of those that are drawn.
std::vector<Tensor> noisy_values(const Tensor& rows, const std::vector<Tensor>& tables,
                                 const std::optional<Tensor>& weights, double threshold,
                                 const std::optional<Tensor>& steps, const std::optional<Tensor>& uniform,
                                 const Tensor& drawn) {
  const Rows from = rows_of(rows, tables, weights, threshold, steps, uniform, drawn);
  const auto real = tables[0].options().requires_grad(false);
  const int64_t n = from.count, f = from.features, k = from.k;
  const std::vector<Tensor> found = {at::empty({n, f}, real), at::empty({n, 6}, real), at::empty({n, k, 3}, real),
                                     at::empty({n, k}, real), at::empty({from.samples, f + 6 + 3 * k}, real)};
  SW_SELECT(noisy_values)(from, {found[0].data_ptr<float>(), found[1].data_ptr<float>(), found[2].data_ptr<float>(),
                                 found[3].data_ptr<float>(), found[4].data_ptr<float>()},
                          splatwizard::torch_parallel());
  return found;
}

// Gradients of the four tables, and of the steps of rows ([0,3] where these are none's own).
std::vector<Tensor> noisy_values_backward(const Tensor& rows, const std::vector<Tensor>& tables,
                                          const std::optional<Tensor>& weights, double threshold,
                                          const std::optional<Tensor>& steps, const std::optional<Tensor>& uniform,
                                          const Tensor& drawn, const std::vector<Tensor>& slopes) {
  const Rows from = rows_of(rows, tables, weights, threshold, steps, uniform, drawn);
  const auto real = tables[0].options().requires_grad(false);
  const int64_t n = from.count, f = from.features, k = from.k;
  TORCH_CHECK(slopes.size() == 5, "sw_anchors: five gradients are needed");
  floats(slopes[0], "gradient of features", {n, f}), floats(slopes[1], "gradient of scales", {n, 6});
  floats(slopes[2], "gradient of offsets", {n, k, 3}), floats(slopes[3], "gradient of masks", {n, k});
  floats(slopes[4], "gradient of the sample", {from.samples, f + 6 + 3 * k});
  std::vector<Tensor> found;
  for (const Tensor& table : tables) found.push_back(at::zeros(table.sizes(), real));
  found.push_back(at::empty({from.step_row > 0 ? n : 0, kGroups}, real));
  const auto at = [](const Tensor& t) { return t.data_ptr<float>(); };
  SW_SELECT(noisy_values_backward)(
      from, {at(slopes[0]), at(slopes[1]), at(slopes[2]), at(slopes[3]), at(slopes[4])},
      {at(found[0]), at(found[1]), at(found[2]), at(found[3]), from.step_row > 0 ? at(found[4]) : nullptr},
      splatwizard::torch_parallel());
  return found;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_anchors, m) {
  m.def("noisy_values(Tensor rows, Tensor[] tables, Tensor? weights, float threshold, Tensor? steps, Tensor? uniform,"
        " Tensor drawn) -> Tensor[]");
  m.def("noisy_values_backward(Tensor rows, Tensor[] tables, Tensor? weights, float threshold, Tensor? steps,"
        " Tensor? uniform, Tensor drawn, Tensor[] slopes) -> Tensor[]");
  m.impl("noisy_values", c10::DispatchKey::CPU, TORCH_FN(noisy_values));
  m.impl("noisy_values_backward", c10::DispatchKey::CPU, TORCH_FN(noisy_values_backward));
}
