// Registers the ops of planes of several scales, and their kernels on the CPU.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <splatwizard/torch_parallel.h>

#include <vector>

#include "kernels.h"

namespace {

using namespace sw_sites;

Sites sites_of(const at::Tensor& cells, const at::Tensor& weights, int64_t channels) {
  TORCH_CHECK(cells.dim() == 4 && cells.size(1) > 0 && cells.size(1) <= kMaxScales && cells.size(2) == kPlanes &&
                  cells.size(3) == kCorners && cells.scalar_type() == at::kInt && cells.is_contiguous() &&
                  cells.is_cpu(),
              "sw_codecs: cells must be contiguous int32 [n, 1 to ", kMaxScales, ", 3, 4] on the CPU");
  TORCH_CHECK(weights.sizes() == cells.sizes() && weights.scalar_type() == at::kFloat && weights.is_contiguous() &&
                  weights.is_cpu() && channels > 0 && channels < 1 << 20,
              "sw_codecs: weights must be contiguous float32 ", cells.sizes());
  Sites at{};
  at.count = cells.size(0), at.scales = int(cells.size(1)), at.channels = int(channels);
  at.cells = cells.const_data_ptr<int32_t>(), at.weights = weights.const_data_ptr<float>();
  return at;
}

// Tables [rows, channels] of the scales -> features [n, scales * 3 * channels].
at::Tensor sites_lookup(const at::Tensor& cells, const at::Tensor& weights, const std::vector<at::Tensor>& tables) {
  TORCH_CHECK(!tables.empty() && tables[0].dim() == 2, "sw_codecs: tables must be [rows, channels]");
  const int64_t channels = tables[0].size(1);
  Sites at = sites_of(cells, weights, channels);
  TORCH_CHECK(int64_t(tables.size()) == at.scales, "sw_codecs: ", at.scales, " tables are needed");
  const float* from[kMaxScales];
  for (int s = 0; s < at.scales; ++s) {
    const at::Tensor& table = tables[s];
    TORCH_CHECK(table.dim() == 2 && table.size(1) == channels && table.scalar_type() == at::kFloat &&
                    table.is_contiguous() && table.is_cpu(),
                "sw_codecs: table ", s, " must be contiguous float32 [rows, ", channels, "]");
    at.rows[s] = table.size(0), from[s] = table.const_data_ptr<float>();
  }
  const at::Tensor found = at::empty({at.count, at.scales * kPlanes * channels},
                                     weights.options().requires_grad(false));
  TORCH_CHECK(SW_SELECT(sites_lookup)(at, from, found.data_ptr<float>(), splatwizard::torch_parallel()),
              "sw_codecs: a cell lies outside its table");
  return found;
}

// Gradients of tables with `rows` rows each; cells are those of a lookup, which has checked them.
std::vector<at::Tensor> sites_backward(const at::Tensor& cells, const at::Tensor& weights, const at::Tensor& gradient,
                                       at::IntArrayRef rows, int64_t channels) {
  const Sites at = sites_of(cells, weights, channels);
  TORCH_CHECK(int64_t(rows.size()) == at.scales && gradient.is_contiguous() && gradient.is_cpu() &&
                  gradient.scalar_type() == at::kFloat &&
                  gradient.numel() == at.count * at.scales * kPlanes * channels,
              "sw_codecs: the gradient must be contiguous float32, as many numbers as the features");
  std::vector<at::Tensor> found;
  float* to[kMaxScales];
  for (int s = 0; s < at.scales; ++s) {
    found.push_back(at::zeros({rows[s], channels}, weights.options().requires_grad(false)));
    to[s] = found.back().data_ptr<float>();
  }
  SW_SELECT(sites_backward)(at, gradient.const_data_ptr<float>(), to, splatwizard::torch_parallel());
  return found;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_codecs, m) {
  m.def("sites_lookup(Tensor cells, Tensor weights, Tensor[] tables) -> Tensor");
  m.def("sites_backward(Tensor cells, Tensor weights, Tensor gradient, int[] rows, int channels) -> Tensor[]");
  m.impl("sites_lookup", c10::DispatchKey::CPU, TORCH_FN(sites_lookup));
  m.impl("sites_backward", c10::DispatchKey::CPU, TORCH_FN(sites_backward));
}
