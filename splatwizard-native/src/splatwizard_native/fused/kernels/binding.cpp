// Registers the training kernels as torch ops; checks what they are handed.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <torch/library.h>

#include <cmath>
#include <tuple>
#include <vector>

#include <splatwizard/torch_parallel.h>

#include "kernels.h"

namespace {

void check(const at::Tensor& tensor, const char* op, const char* name) {
  TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == at::kFloat && tensor.is_contiguous(), op, ": ", name,
              " must be a contiguous float32 tensor on the CPU, got ", tensor.toString());
}

// Means of |x-y| and of the SSIM map, and d(l1_weight * l1 + ssim_weight * ssim)/dx (empty unless with_grad).
std::tuple<double, double, at::Tensor> photometric(const at::Tensor& x, const at::Tensor& y, bool valid,
                                                   double l1_weight, double ssim_weight, bool with_grad) {
  check(x, "photometric", "x");
  check(y, "photometric", "y");
  TORCH_CHECK(x.dim() == 3 && x.sizes() == y.sizes(), "photometric: x and y must be [C,H,W] and alike, got ",
              x.sizes(), " and ", y.sizes());
  const int64_t planes = x.size(0), height = x.size(1), width = x.size(2);
  const int64_t lost = valid ? 10 : 0;
  TORCH_CHECK(planes > 0 && height > lost && width > lost, "photometric: the image ", x.sizes(), " is too small");
  const double pixels = static_cast<double>(x.numel());
  const double mapped = static_cast<double>(planes) * (height - lost) * (width - lost);
  at::Tensor grad = with_grad ? at::empty_like(x) : at::empty({0}, x.options());
  std::vector<double> rows(2 * planes * height);
  splatwizard::PhotometricArgs args{
      x.const_data_ptr<float>(), y.const_data_ptr<float>(), planes, height, width, valid,
      static_cast<float>(l1_weight / pixels), static_cast<float>(ssim_weight / mapped),
      with_grad ? grad.mutable_data_ptr<float>() : nullptr, rows.data(), rows.data() + planes * height};
  SW_SELECT(photometric)(args, splatwizard::torch_parallel());
  double l1 = 0., ssim = 0.;
  for (int64_t row = 0; row < planes * height; ++row) {
    l1 += args.row_l1[row];
    ssim += args.row_ssim[row];
  }
  return {l1 / pixels, ssim / mapped, grad};
}

void adam(const at::Tensor& param, const at::Tensor& grad, const at::Tensor& exp_avg, const at::Tensor& exp_avg_sq,
          double lr, double beta1, double beta2, double eps, int64_t step) {
  check(param, "adam", "param");
  check(grad, "adam", "grad");
  check(exp_avg, "adam", "exp_avg");
  check(exp_avg_sq, "adam", "exp_avg_sq");
  const int64_t count = param.numel();
  TORCH_CHECK(grad.numel() == count && exp_avg.numel() == count && exp_avg_sq.numel() == count,
              "adam: param, grad, exp_avg and exp_avg_sq differ in size: ", count, ", ", grad.numel(), ", ",
              exp_avg.numel(), ", ", exp_avg_sq.numel());
  TORCH_CHECK(step >= 1, "adam: step counts from 1, got ", step);
  const double t = static_cast<double>(step);
  const splatwizard::AdamArgs args{
      param.mutable_data_ptr<float>(), grad.const_data_ptr<float>(), exp_avg.mutable_data_ptr<float>(),
      exp_avg_sq.mutable_data_ptr<float>(), count,
      static_cast<float>(lr / (1. - std::pow(beta1, t))), static_cast<float>(1. - beta1),
      static_cast<float>(beta2), static_cast<float>(1. - beta2),
      static_cast<float>(1. / std::sqrt(1. - std::pow(beta2, t))), static_cast<float>(eps)};
  SW_SELECT(adam)(args, splatwizard::torch_parallel());
}

}  // namespace

TORCH_LIBRARY(splatwizard_training, m) {
  m.def("photometric(Tensor x, Tensor y, bool valid, float l1_weight, float ssim_weight, bool with_grad)"
        " -> (float, float, Tensor)");
  m.def("adam(Tensor(a!) param, Tensor grad, Tensor(b!) exp_avg, Tensor(c!) exp_avg_sq, float lr, float beta1,"
        " float beta2, float eps, int step) -> ()");
  // On CUDA, where nothing may wait for a number: means [3] = offset + weighted sum, L1, SSIM; see binding_cuda.cpp.
  m.def("photometric_means(Tensor x, Tensor y, bool valid, float l1_weight, float ssim_weight, float offset,"
        " bool with_grad) -> (Tensor means, Tensor slopes)");
  m.def("photometric_backward(Tensor x, Tensor y, Tensor slopes, Tensor scale, bool valid, float l1_weight,"
        " float ssim_weight) -> Tensor");
  m.def("adam_many(Tensor(a!)[] params, Tensor[] grads, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs, float[] lrs,"
        " float[] beta1s, float[] beta2s, float[] epss, int[] steps) -> int[]");
  m.impl("photometric", c10::DispatchKey::CPU, TORCH_FN(photometric));
  m.impl("adam", c10::DispatchKey::CPU, TORCH_FN(adam));
}
