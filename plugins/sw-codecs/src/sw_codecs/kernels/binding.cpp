// Registers the ops of grids of real numbers, of Huffman codes and of codebooks, and their kernels on the CPU.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <torch/library.h>

#include <splatwizard/torch_parallel.h>

#include <optional>
#include <tuple>

#include "binding.h"
#include "kernels.h"

namespace {

using namespace sw_grid;

at::Tensor lookup(const at::Tensor& x, const at::Tensor& values, at::ArrayRef<double> scales, at::IntArrayRef lasts,
                  at::IntArrayRef starts, at::IntArrayRef dense, int64_t log2_size) {
  TORCH_CHECK(x.dim() == 2 && values.dim() == 2, "sw_codecs: x must be [n,2 or 3], values [entries,features]");
  const int64_t n = x.size(0), axes = x.size(1), features = values.size(1);
  const Levels levels = levels_of(scales, lasts, starts, dense, log2_size, axes, values.size(0));
  check(x, "x", x, {n, axes});
  check(values, "values", x, {values.size(0), features});
  at::Tensor found = at::empty({n, levels.count * features}, x.options().requires_grad(false));
  SW_SELECT(grid_lookup)(levels, int(axes), int(features), n, x.const_data_ptr<float>(),
                         values.const_data_ptr<float>(), found.mutable_data_ptr<float>(),
                         splatwizard::torch_parallel());
  return found;
}

at::Tensor backward(const at::Tensor& x, const at::Tensor& gradient, int64_t entries, int64_t features,
                    at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts, at::IntArrayRef dense,
                    int64_t log2_size, const std::optional<at::Tensor>& /*largest*/) {
  TORCH_CHECK(x.dim() == 2 && features > 0, "sw_codecs: x must be [n,2 or 3]");
  const int64_t n = x.size(0), axes = x.size(1);
  const Levels levels = levels_of(scales, lasts, starts, dense, log2_size, axes, entries);
  check(x, "x", x, {n, axes});
  check(gradient, "gradient", x, {n, levels.count * features});
  at::Tensor table = at::zeros({entries, features}, x.options().requires_grad(false));
  SW_SELECT(grid_backward)(levels, int(axes), int(features), n, x.const_data_ptr<float>(),
                           gradient.const_data_ptr<float>(), table.mutable_data_ptr<float>(),
                           splatwizard::torch_parallel());
  return table;
}

void signs_lookup(const at::Tensor& x, at::IntArrayRef axes, const at::Tensor& table, at::Tensor found, int64_t first,
                  at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts, at::IntArrayRef dense,
                  int64_t log2_size) {
  const Signs at = signs_of(x, axes, table, found, first, scales, lasts, starts, dense, log2_size);
  SW_SELECT(signs_lookup)(at, table.const_data_ptr<float>(), found.mutable_data_ptr<float>() + first,
                          splatwizard::torch_parallel());
}

void signs_backward(const at::Tensor& x, at::IntArrayRef axes, at::Tensor table, const at::Tensor& gradient,
                    int64_t first, at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts,
                    at::IntArrayRef dense, int64_t log2_size, const std::optional<at::Tensor>& /*largest*/) {
  const Signs at = signs_of(x, axes, table, gradient, first, scales, lasts, starts, dense, log2_size);
  SW_SELECT(signs_backward)(at, gradient.const_data_ptr<float>() + first, table.mutable_data_ptr<float>(),
                            splatwizard::torch_parallel());
}

// bytes [length] uint8, counts [trees, size] float32 and no NaN, index [n] int64 -> symbols [n] int32, or none if the
// bytes do not suffice.
at::Tensor huffman_decode(const at::Tensor& bytes, const at::Tensor& counts, const at::Tensor& index) {
  TORCH_CHECK(bytes.is_cpu() && bytes.scalar_type() == at::kByte && bytes.is_contiguous() && counts.is_cpu() &&
                  counts.scalar_type() == at::kFloat && counts.is_contiguous() && counts.dim() == 2 &&
                  index.is_cpu() && index.scalar_type() == at::kLong && index.is_contiguous(),
              "huffman_decode: bytes must be uint8, counts [trees,size] float32, index int64, all contiguous on a CPU");
  const int64_t trees = counts.size(0), size = counts.size(1), n = index.numel();
  TORCH_CHECK(trees > 0 && size >= 2 && trees * size <= int64_t(1) << 28, "huffman_decode: malformed counts");
  const int64_t* rows = index.const_data_ptr<int64_t>();
  for (int64_t i = 0; i < n; ++i)
    TORCH_CHECK(rows[i] >= 0 && rows[i] < trees, "huffman_decode: a symbol has table ", rows[i], " of ", trees);
  at::Tensor symbols = at::empty({n}, index.options().dtype(at::kInt));
  const bool all = SW_SELECT(huffman_decode)(bytes.const_data_ptr<uint8_t>(), bytes.numel(),
                                             counts.const_data_ptr<float>(), trees, size, rows, n,
                                             symbols.mutable_data_ptr<int32_t>());
  return all ? symbols : symbols.narrow(0, 0, 0);
}

// rows [n, dim], entries [size, dim] float32 -> the nearest entry of each row, int64 [n], and the share 0..1 of the
// distances that were computed.
std::tuple<at::Tensor, double> nearest_entries(const at::Tensor& rows, const at::Tensor& entries) {
  TORCH_CHECK(rows.dim() == 2 && entries.dim() == 2 && entries.size(0) > 0 && rows.size(1) == entries.size(1) &&
                  rows.size(1) > 0 && rows.size(1) <= 1 << 16 && rows.is_cpu() && entries.is_cpu() &&
                  rows.scalar_type() == at::kFloat && entries.scalar_type() == at::kFloat && rows.is_contiguous() &&
                  entries.is_contiguous(),
              "nearest_entries: rows [n,d], entries [k,d], contiguous float32 on a CPU, got ", rows.sizes(), " and ",
              entries.sizes());
  at::Tensor index = at::empty({rows.size(0)}, rows.options().dtype(at::kLong).requires_grad(false));
  const double share = SW_SELECT(nearest_entries)(
      rows.const_data_ptr<float>(), rows.size(0), entries.const_data_ptr<float>(), entries.size(0),
      int(entries.size(1)), index.mutable_data_ptr<int64_t>(), splatwizard::torch_parallel());
  return {index, share};
}

}  // namespace

TORCH_LIBRARY(sw_codecs, m) {
  m.def("lookup(Tensor x, Tensor values, float[] scales, int[] lasts, int[] starts, int[] dense, int log2_size)"
        " -> Tensor");
  // With `largest`, which no number of the gradient exceeds, sums are the same in any order; on a CPU they always are.
  m.def("backward(Tensor x, Tensor gradient, int entries, int features, float[] scales, int[] lasts, int[] starts,"
        " int[] dense, int log2_size, Tensor? largest=None) -> Tensor");
  // Features of grids of signs into columns of `found`, and their gradients added to `table`.
  m.def("signs_lookup(Tensor x, int[] axes, Tensor table, Tensor(a!) found, int first, float[] scales, int[] lasts,"
        " int[] starts, int[] dense, int log2_size) -> ()");
  m.def("signs_backward(Tensor x, int[] axes, Tensor(a!) table, Tensor gradient, int first, float[] scales,"
        " int[] lasts, int[] starts, int[] dense, int log2_size, Tensor? largest=None) -> ()");
  m.impl("signs_lookup", c10::DispatchKey::CPU, TORCH_FN(signs_lookup));
  m.impl("signs_backward", c10::DispatchKey::CPU, TORCH_FN(signs_backward));
  m.def("huffman_decode(Tensor bytes, Tensor counts, Tensor index) -> Tensor");
  m.impl("huffman_decode", c10::DispatchKey::CPU, TORCH_FN(huffman_decode));
  m.def("nearest_entries(Tensor rows, Tensor entries) -> (Tensor, float)");
  m.impl("nearest_entries", c10::DispatchKey::CPU, TORCH_FN(nearest_entries));
  m.impl("lookup", c10::DispatchKey::CPU, TORCH_FN(lookup));
  m.impl("backward", c10::DispatchKey::CPU, TORCH_FN(backward));
}
