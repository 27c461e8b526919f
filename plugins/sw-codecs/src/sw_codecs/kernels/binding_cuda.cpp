// Grids on CUDA as torch ops, on the current stream. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include "binding.h"
#include "cuda/kernels.h"
#include "sums.h"

namespace {

using namespace sw_grid;

// Pairs are read and added as one number of eight bytes.
void check_pairs(const at::Tensor& t, const char* name, int64_t features) {
  TORCH_CHECK(features > 0 && features <= kMaxFeatures, "sw_codecs: ", features,
              " features are not offered on CUDA");
  TORCH_CHECK(features != 2 || reinterpret_cast<uintptr_t>(t.const_data_ptr()) % 8 == 0, "sw_codecs: ", name,
              " must start at a multiple of 8 bytes; clone() it");
}

at::Tensor lookup(const at::Tensor& x, const at::Tensor& values, at::ArrayRef<double> scales, at::IntArrayRef lasts,
                  at::IntArrayRef starts, at::IntArrayRef dense, int64_t log2_size) {
  TORCH_CHECK(x.dim() == 2 && values.dim() == 2, "sw_codecs: x must be [n,2 or 3], values [entries,features]");
  const int64_t n = x.size(0), axes = x.size(1), features = values.size(1);
  const Levels levels = levels_of(scales, lasts, starts, dense, log2_size, axes, values.size(0));
  check(x, "x", x, {n, axes});
  check(values, "values", x, {values.size(0), features});
  check_pairs(values, "values", features);
  const c10::cuda::CUDAGuard guard(x.device());
  at::Tensor found = at::empty({n, levels.count * features}, x.options().requires_grad(false));
  if (n > 0)
    sw_grid::cuda::lookup(levels, int(axes), int(features), n, x.const_data_ptr<float>(),
                          values.const_data_ptr<float>(), found.mutable_data_ptr<float>(),
                          c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

at::Tensor backward(const at::Tensor& x, const at::Tensor& gradient, int64_t entries, int64_t features,
                    at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts, at::IntArrayRef dense,
                    int64_t log2_size, const std::optional<at::Tensor>& largest) {
  TORCH_CHECK(x.dim() == 2, "sw_codecs: x must be [n,2 or 3]");
  const int64_t n = x.size(0), axes = x.size(1);
  const Levels levels = levels_of(scales, lasts, starts, dense, log2_size, axes, entries);
  check(x, "x", x, {n, axes});
  check(gradient, "gradient", x, {n, levels.count * features});
  const c10::cuda::CUDAGuard guard(x.device());
  const auto stream = c10::cuda::getCurrentCUDAStream();
  at::Tensor table = at::zeros({entries, features}, x.options().requires_grad(false));
  check_pairs(table, "the table", features);
  const float *places = x.const_data_ptr<float>(), *slopes = gradient.const_data_ptr<float>();
  if (n > 0 && largest.has_value()) {
    const sw_sums::Held held(*largest, table, n << axes);
    sw_grid::cuda::backward(levels, int(axes), int(features), n, places, slopes, held.sums, stream);
    sw_grid::cuda::add_sums(held.sums, table.numel(), table.mutable_data_ptr<float>(), stream);
  } else if (n > 0) {
    sw_grid::cuda::backward(levels, int(axes), int(features), n, places, slopes, table.mutable_data_ptr<float>(),
                            stream);
  }
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return table;
}

bool are_fours(const Signs& at, const at::Tensor& table, const float* features) {
  return at.features == 4 && at.row % 4 == 0 && reinterpret_cast<uintptr_t>(table.const_data_ptr()) % 16 == 0 &&
         reinterpret_cast<uintptr_t>(features) % 16 == 0;
}

void signs_lookup(const at::Tensor& x, at::IntArrayRef axes, const at::Tensor& table, at::Tensor found, int64_t first,
                  at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts, at::IntArrayRef dense,
                  int64_t log2_size) {
  const Signs at = signs_of(x, axes, table, found, first, scales, lasts, starts, dense, log2_size);
  const c10::cuda::CUDAGuard guard(x.device());
  float* to = found.mutable_data_ptr<float>() + first;
  if (at.count > 0)
    sw_grid::cuda::signs_lookup(at, are_fours(at, table, to), table.const_data_ptr<float>(), to,
                                c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
}

void signs_backward(const at::Tensor& x, at::IntArrayRef axes, at::Tensor table, const at::Tensor& gradient,
                    int64_t first, at::ArrayRef<double> scales, at::IntArrayRef lasts, at::IntArrayRef starts,
                    at::IntArrayRef dense, int64_t log2_size, const std::optional<at::Tensor>& largest) {
  const Signs at = signs_of(x, axes, table, gradient, first, scales, lasts, starts, dense, log2_size);
  const c10::cuda::CUDAGuard guard(x.device());
  const auto stream = c10::cuda::getCurrentCUDAStream();
  const float* from = gradient.const_data_ptr<float>() + first;
  const bool four = are_fours(at, table, from);
  float* to = table.mutable_data_ptr<float>();
  if (at.count > 0 && largest.has_value()) {
    const sw_sums::Held held(*largest, table, at.count << at.axes);
    sw_grid::cuda::signs_backward(at, four, from, held.sums, stream);
    sw_grid::cuda::add_sums(held.sums, table.numel(), to, stream);
  } else if (at.count > 0) {
    sw_grid::cuda::signs_backward(at, four, from, to, stream);
  }
  C10_CUDA_KERNEL_LAUNCH_CHECK();
}

}  // namespace

TORCH_LIBRARY(sw_codecs, m) {
  m.def("lookup(Tensor x, Tensor values, float[] scales, int[] lasts, int[] starts, int[] dense, int log2_size)"
        " -> Tensor");
  // With `largest`, which no number of the gradient exceeds, sums are the same in any order.
  m.def("backward(Tensor x, Tensor gradient, int entries, int features, float[] scales, int[] lasts, int[] starts,"
        " int[] dense, int log2_size, Tensor? largest=None) -> Tensor");
  // Features of grids of signs into columns of `found`, and their gradients added to `table`.
  m.def("signs_lookup(Tensor x, int[] axes, Tensor table, Tensor(a!) found, int first, float[] scales, int[] lasts,"
        " int[] starts, int[] dense, int log2_size) -> ()");
  m.def("signs_backward(Tensor x, int[] axes, Tensor(a!) table, Tensor gradient, int first, float[] scales,"
        " int[] lasts, int[] starts, int[] dense, int log2_size, Tensor? largest=None) -> ()");
}

TORCH_LIBRARY_IMPL(sw_codecs, CUDA, m) {
  m.impl("lookup", lookup);
  m.impl("backward", backward);
  m.impl("signs_lookup", signs_lookup);
  m.impl("signs_backward", signs_backward);
}

#endif  // SW_WITH_CUDA
