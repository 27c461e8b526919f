// The kernels on CUDA as torch ops, on the current stream. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty_like.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <algorithm>
#include <cmath>
#include <initializer_list>
#include <tuple>
#include <utility>
#include <vector>

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

// False: the kernel does not take these tensors, and nothing is done.
bool fragment_statistics(const at::Tensor& gradients, const at::Tensor& logits, const at::Tensor& fragments,
                         const at::Tensor& sums, double least_clear) {
  const int64_t count = logits.numel();
  const std::pair<const at::Tensor*, int64_t> sizes[] = {
      {&gradients, count}, {&logits, count}, {&fragments, 2 * count}, {&sums, 3 * count}};
  for (const auto& [tensor, size] : sizes)
    if (!tensor->is_cuda() || tensor->device() != sums.device() || tensor->scalar_type() != at::kFloat ||
        !tensor->is_contiguous() || tensor->numel() != size)
      return false;
  if (reinterpret_cast<uintptr_t>(fragments.const_data_ptr()) % 8 != 0) return false;
  const c10::cuda::CUDAGuard guard(sums.device());
  kernels::fragment_statistics({gradients.const_data_ptr<float>(), logits.const_data_ptr<float>(),
                                fragments.const_data_ptr<float>(), sums.mutable_data_ptr<float>(),
                                float(least_clear), count},
                               c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return true;
}

// Whether the kernel can update this parameter: float32, contiguous and aligned, on the mask's GPU, a row a mark.
bool fits_sparse_adam(const at::Tensor& mask, const at::Tensor& steps,
                      std::initializer_list<const at::Tensor*> tensors) {
  const at::Tensor& param = **tensors.begin();
  for (const at::Tensor* tensor : tensors)
    if (tensor->device() != mask.device() || tensor->scalar_type() != at::kFloat || !tensor->is_contiguous() ||
        tensor->sizes() != param.sizes() || reinterpret_cast<uintptr_t>(tensor->const_data_ptr()) % 16 != 0)
      return false;
  if (param.dim() == 0 || param.size(0) != mask.size(0) || param.numel() >= (mask.size(0) << 20)) return false;
  return steps.numel() == 0 || (steps.device() == mask.device() && steps.scalar_type() == at::kInt &&
                                steps.is_contiguous() && steps.numel() == mask.size(0));
}

std::vector<int64_t> sparse_adam_many(const std::vector<at::Tensor>& params, const std::vector<at::Tensor>& grads,
                                      const std::vector<at::Tensor>& exp_avgs,
                                      const std::vector<at::Tensor>& exp_avg_sqs,
                                      const std::vector<at::Tensor>& row_steps, const at::Tensor& mask,
                                      at::ArrayRef<double> lrs, at::ArrayRef<double> beta1s,
                                      at::ArrayRef<double> beta2s, at::ArrayRef<double> epss) {
  const size_t count = params.size();
  TORCH_CHECK(grads.size() == count && exp_avgs.size() == count && exp_avg_sqs.size() == count &&
                  row_steps.size() == count && lrs.size() == count && beta1s.size() == count &&
                  beta2s.size() == count && epss.size() == count,
              "sparse_adam: lists of different lengths");
  TORCH_CHECK(mask.is_cuda() && mask.scalar_type() == at::kBool && mask.is_contiguous() && mask.dim() == 1,
              "sparse_adam: mask must be a contiguous bool tensor [N] on a GPU, got ", mask.toString());
  const c10::cuda::CUDAGuard guard(mask.device());
  std::vector<int64_t> left;
  std::vector<kernels::SparseAdamTensor> tensors;
  for (size_t i = 0; i < count; ++i) {
    if (!fits_sparse_adam(mask, row_steps[i], {&params[i], &grads[i], &exp_avgs[i], &exp_avg_sqs[i]})) {
      left.push_back(int64_t(i));
      continue;
    }
    tensors.push_back({params[i].mutable_data_ptr<float>(), grads[i].const_data_ptr<float>(),
                       exp_avgs[i].mutable_data_ptr<float>(), exp_avg_sqs[i].mutable_data_ptr<float>(),
                       row_steps[i].numel() > 0 ? row_steps[i].mutable_data_ptr<int32_t>() : nullptr,
                       mask.size(0) > 0 ? params[i].numel() / mask.size(0) : 0, float(lrs[i]),
                       float(std::log(beta1s[i])), float(std::log(beta2s[i])), float(1. - beta1s[i]),
                       float(beta2s[i]), float(1. - beta2s[i]), float(epss[i])});
  }
  for (size_t first = 0; first < tensors.size(); first += kernels::kSparseAdamTensors)
    kernels::sparse_adam(tensors.data() + first,
                         int(std::min<size_t>(kernels::kSparseAdamTensors, tensors.size() - first)),
                         mask.const_data_ptr<bool>(), mask.size(0), c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return left;
}

kernels::Surface surface_of(const at::Tensor& depth, const at::Tensor& normals, const at::Tensor& alpha,
                            c10::ArrayRef<double> lens) {
  check(depth, "disagreement", "depth");
  check(normals, "disagreement", "normals");
  check(alpha, "disagreement", "alpha");
  TORCH_CHECK(lens.size() == 4, "disagreement: focal_and_center must be fx, fy, cx, cy");
  TORCH_CHECK(depth.dim() == 3 && depth.size(0) == 1 && alpha.sizes() == depth.sizes() && normals.dim() == 3 &&
                  normals.size(0) == 3 && normals.size(1) == depth.size(1) && normals.size(2) == depth.size(2) &&
                  normals.device() == depth.device() && alpha.device() == depth.device(),
              "disagreement: depth and alpha [1,H,W] and normals [3,H,W] do not fit: ", depth.sizes(), ", ",
              alpha.sizes(), ", ", normals.sizes());
  return {depth.const_data_ptr<float>(), normals.const_data_ptr<float>(), alpha.const_data_ptr<float>(),
          int32_t(depth.size(2)), int32_t(depth.size(1)), float(lens[0]), float(lens[1]), float(lens[2]),
          float(lens[3])};
}

at::Tensor disagreement(const at::Tensor& depth, const at::Tensor& normals, const at::Tensor& alpha,
                        c10::ArrayRef<double> lens) {
  const kernels::Surface surface = surface_of(depth, normals, alpha, lens);
  const c10::cuda::CUDAGuard guard(depth.device());
  at::Tensor found = at::empty_like(depth);
  kernels::disagreement(surface, found.mutable_data_ptr<float>(), c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

std::tuple<at::Tensor, at::Tensor> disagreement_backward(const at::Tensor& grad, const at::Tensor& depth,
                                                         const at::Tensor& normals, const at::Tensor& alpha,
                                                         c10::ArrayRef<double> lens) {
  const kernels::Surface surface = surface_of(depth, normals, alpha, lens);
  check(grad, "disagreement", "grad");
  TORCH_CHECK(grad.sizes() == depth.sizes() && grad.device() == depth.device(), "disagreement: grad does not fit");
  const c10::cuda::CUDAGuard guard(depth.device());
  at::Tensor to_depth = at::empty_like(depth), to_normals = at::empty_like(normals);
  kernels::disagreement_backward(surface, grad.const_data_ptr<float>(), to_depth.mutable_data_ptr<float>(),
                                 to_normals.mutable_data_ptr<float>(), c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return {to_depth, to_normals};
}

}  // namespace

TORCH_LIBRARY(splatwizard_gaussians, m) {
  // Of no elements in row_steps: no bias correction. Returns the places of those that the kernel cannot take, which are
  // left as they were.
  m.def("sparse_adam_many(Tensor(a!)[] params, Tensor[] grads, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs,"
        " Tensor(d!)[] row_steps, Tensor mask, float[] lrs, float[] beta1s, float[] beta2s, float[] epss) -> int[]");
  m.def("view_statistics(Tensor gradients, Tensor radii, Tensor(a!) grad_accum, Tensor(b!) denom,"
        " Tensor(c!) max_radii) -> ()");
  m.def("fragment_statistics(Tensor gradients, Tensor logits, Tensor fragments, Tensor(a!) sums, float least_clear)"
        " -> bool");
  m.def("disagreement(Tensor depth, Tensor normals, Tensor alpha, float[] focal_and_center) -> Tensor");
  m.def("disagreement_backward(Tensor grad, Tensor depth, Tensor normals, Tensor alpha, float[] focal_and_center)"
        " -> (Tensor, Tensor)");
}

TORCH_LIBRARY_IMPL(splatwizard_gaussians, CUDA, m) {
  m.impl("sparse_adam_many", sparse_adam_many);
  m.impl("view_statistics", view_statistics);
  m.impl("fragment_statistics", fragment_statistics);
  m.impl("disagreement", disagreement);
  m.impl("disagreement_backward", disagreement_backward);
}

#endif  // SW_WITH_CUDA
