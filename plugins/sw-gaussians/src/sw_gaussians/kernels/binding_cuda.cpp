// The kernels on CUDA as torch ops, on the current stream. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <utility>

#include "cuda/kernels.h"

namespace {

namespace kernels = splatwizard::cuda;

void check(const at::Tensor& tensor, const char* op, const char* name) {
  TORCH_CHECK(tensor.is_cuda() && tensor.scalar_type() == at::kFloat && tensor.is_contiguous(), op, ": ", name,
              " must be a contiguous float32 tensor on a GPU, got ", tensor.toString());
}

void view_statistics(const at::Tensor& gradients, const at::Tensor& radii, const at::Tensor& grad_accum,
                     const at::Tensor& denom, const at::Tensor& max_radii) {
  const int64_t count = radii.numel();
  TORCH_CHECK(radii.is_cuda() && radii.scalar_type() == at::kInt && radii.is_contiguous(),
              "view_statistics: radii must be a contiguous int32 tensor on a GPU, got ", radii.toString());
  check(gradients, "view_statistics", "gradients");
  TORCH_CHECK(gradients.numel() == 2 * count && gradients.device() == radii.device() &&
                  reinterpret_cast<uintptr_t>(gradients.const_data_ptr()) % 8 == 0,
              "view_statistics: gradients do not fit the radii");
  const std::pair<const char*, const at::Tensor*> sums[] = {
      {"grad_accum", &grad_accum}, {"denom", &denom}, {"max_radii", &max_radii}};
  for (const auto& [name, tensor] : sums) {
    check(*tensor, "view_statistics", name);
    TORCH_CHECK(tensor->numel() == count && tensor->device() == radii.device(), "view_statistics: ", name,
                " does not fit the radii");
  }
  const c10::cuda::CUDAGuard guard(radii.device());
  kernels::statistics({gradients.const_data_ptr<float>(), radii.const_data_ptr<int32_t>(),
                       grad_accum.mutable_data_ptr<float>(), denom.mutable_data_ptr<float>(),
                       max_radii.mutable_data_ptr<float>(), count},
                      c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
}

}  // namespace

TORCH_LIBRARY_IMPL(splatwizard_gaussians, CUDA, m) {
  m.impl("view_statistics", view_statistics);
}

#endif  // SW_WITH_CUDA
