// Registers the kernels of training Gaussians as torch ops; checks what they are handed.
#include <ATen/core/Tensor.h>
#include <torch/library.h>

#include <cmath>
#include <optional>

#include <splatwizard/torch_parallel.h>

#include "kernels.h"

namespace {

void check(const at::Tensor& tensor, const char* op, const char* name) {
  TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == at::kFloat && tensor.is_contiguous(), op, ": ", name,
              " must be a contiguous float32 tensor on the CPU, got ", tensor.toString());
}

// mask [N] bool; row_steps [N] int32 or nothing: no bias correction.
void sparse_adam(const at::Tensor& param, const at::Tensor& grad, const at::Tensor& exp_avg,
                 const at::Tensor& exp_avg_sq, const at::Tensor& mask, const std::optional<at::Tensor>& row_steps,
                 double lr, double beta1, double beta2, double eps) {
  check(param, "sparse_adam", "param");
  check(grad, "sparse_adam", "grad");
  check(exp_avg, "sparse_adam", "exp_avg");
  check(exp_avg_sq, "sparse_adam", "exp_avg_sq");
  const int64_t count = param.numel();
  const int64_t rows = param.dim() > 0 ? param.size(0) : 0;
  TORCH_CHECK(grad.numel() == count && exp_avg.numel() == count && exp_avg_sq.numel() == count,
              "sparse_adam: param, grad, exp_avg and exp_avg_sq differ in size");
  TORCH_CHECK(mask.is_cpu() && mask.scalar_type() == at::kBool && mask.is_contiguous() && mask.dim() == 1 &&
                  mask.size(0) == rows && param.dim() > 0,
              "sparse_adam: mask must be a contiguous bool tensor [", rows, "] on the CPU, got ", mask.sizes());
  int32_t* steps = nullptr;
  if (row_steps.has_value()) {
    TORCH_CHECK(row_steps->is_cpu() && row_steps->scalar_type() == at::kInt && row_steps->is_contiguous() &&
                    row_steps->numel() == rows,
                "sparse_adam: row_steps must be a contiguous int32 tensor [", rows, "] on the CPU");
    steps = row_steps->mutable_data_ptr<int32_t>();
  }
  if (count == 0) return;
  const splatwizard::SparseAdamArgs args{
      param.mutable_data_ptr<float>(), grad.const_data_ptr<float>(), exp_avg.mutable_data_ptr<float>(),
      exp_avg_sq.mutable_data_ptr<float>(), mask.const_data_ptr<bool>(), steps, rows, count / rows, lr,
      std::log(beta1), std::log(beta2), static_cast<float>(1. - beta1), static_cast<float>(beta2),
      static_cast<float>(1. - beta2), static_cast<float>(eps)};
  SW_SELECT(sparse_adam)(args, splatwizard::torch_parallel());
}

}  // namespace

TORCH_LIBRARY(splatwizard_gaussians, m) {
  m.def("sparse_adam(Tensor(a!) param, Tensor grad, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, Tensor mask,"
        " Tensor(d!)? row_steps, float lr, float beta1, float beta2, float eps) -> ()");
  // On CUDA alone, see binding_cuda.cpp. Of no elements in row_steps: no bias correction. Returns the places of those
  // that the kernel cannot take, which are left as they were.
  m.def("sparse_adam_many(Tensor(a!)[] params, Tensor[] grads, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs,"
        " Tensor(d!)[] row_steps, Tensor mask, float[] lrs, float[] beta1s, float[] beta2s, float[] epss) -> int[]");
  m.def("view_statistics(Tensor gradients, Tensor radii, Tensor(a!) grad_accum, Tensor(b!) denom,"
        " Tensor(c!) max_radii) -> ()");
  m.def("fragment_statistics(Tensor gradients, Tensor logits, Tensor fragments, Tensor(a!) sums, float least_clear)"
        " -> bool");
  m.def("disagreement(Tensor depth, Tensor normals, Tensor alpha, float[] focal_and_center) -> Tensor");
  m.def("disagreement_backward(Tensor grad, Tensor depth, Tensor normals, Tensor alpha, float[] focal_and_center)"
        " -> (Tensor, Tensor)");
  m.impl("sparse_adam", c10::DispatchKey::CPU, TORCH_FN(sparse_adam));
}
