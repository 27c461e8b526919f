// Registers the training kernels as torch ops; checks what they are handed.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <torch/library.h>

#include <cmath>
#include <tuple>
#include <vector>

#include <splatwizard/torch_parallel.h>

#include "adam_lists.h"
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

// One step of many tensors. Returns the places of those that the kernel cannot take: they are left as they were.
std::vector<int64_t> adam_many(const std::vector<at::Tensor>& params, const std::vector<at::Tensor>& grads,
                               const std::vector<at::Tensor>& exp_avgs, const std::vector<at::Tensor>& exp_avg_sqs,
                               at::ArrayRef<double> lrs, at::ArrayRef<double> beta1s, at::ArrayRef<double> beta2s,
                               at::ArrayRef<double> epss, at::IntArrayRef steps) {
  const size_t count =
      splatwizard::adam_count(params, {&grads, &exp_avgs, &exp_avg_sqs}, {lrs, beta1s, beta2s, epss}, steps);
  std::vector<int64_t> left;
  for (size_t i = 0; i < count; ++i) {
    const at::Tensor& param = params[i];
    if (!splatwizard::fits_adam(at::kCPU, 1, steps[i], {&param, &grads[i], &exp_avgs[i], &exp_avg_sqs[i]})) {
      left.push_back(int64_t(i));
      continue;
    }
    const double t = static_cast<double>(steps[i]), beta1 = beta1s[i], beta2 = beta2s[i];
    const splatwizard::AdamArgs args{
        param.mutable_data_ptr<float>(), grads[i].const_data_ptr<float>(), exp_avgs[i].mutable_data_ptr<float>(),
        exp_avg_sqs[i].mutable_data_ptr<float>(), param.numel(),
        static_cast<float>(lrs[i] / (1. - std::pow(beta1, t))), static_cast<float>(1. - beta1),
        static_cast<float>(beta2), static_cast<float>(1. - beta2),
        static_cast<float>(1. / std::sqrt(1. - std::pow(beta2, t))), static_cast<float>(epss[i])};
    SW_SELECT(adam)(args, splatwizard::torch_parallel());
  }
  splatwizard::count_versions(params);
  return left;
}

}  // namespace

TORCH_LIBRARY(splatwizard_training, m) {
  m.def("photometric(Tensor x, Tensor y, bool valid, float l1_weight, float ssim_weight, bool with_grad)"
        " -> (float, float, Tensor)");
  // On CUDA, differentiable: offset + weighted sum, L1, SSIM, none of which the host waits for; see binding_cuda.cpp.
  m.def("photometric_loss(Tensor x, Tensor y, bool valid, float l1_weight, float ssim_weight, float offset)"
        " -> (Tensor total, Tensor l1, Tensor similarity)");
  m.def("activate(Tensor log_scales, Tensor opacity_logits) -> (Tensor scales, Tensor opacities)");  // on CUDA
  m.def("adam_many(Tensor(a!)[] params, Tensor[] grads, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs, float[] lrs,"
        " float[] beta1s, float[] beta2s, float[] epss, int[] steps) -> int[]");
  m.impl("photometric", c10::DispatchKey::CPU, TORCH_FN(photometric));
  m.impl("adam_many", c10::DispatchKey::CPU, TORCH_FN(adam_many));
}
