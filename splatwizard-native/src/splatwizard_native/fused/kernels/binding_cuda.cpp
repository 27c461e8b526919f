// The training kernels on CUDA as torch ops, on the current stream. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/LegacyTypeDispatch.h>
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/csrc/autograd/custom_function.h>
#include <torch/library.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <tuple>
#include <vector>

#include "adam_lists.h"
#include "cuda/kernels.h"

namespace {

namespace kernels = splatwizard::cuda;

void check(const at::Tensor& tensor, const char* op, const char* name) {
  TORCH_CHECK(tensor.is_cuda() && tensor.scalar_type() == at::kFloat && tensor.is_contiguous(), op, ": ", name,
              " must be a contiguous float32 tensor on a GPU, got ", tensor.toString());
}

struct Weights {
  bool valid;
  double l1, ssim, offset;
};

kernels::Photometric photometric_args(const at::Tensor& x, const at::Tensor& y, const Weights& weights) {
  check(x, "photometric_loss", "x");
  check(y, "photometric_loss", "y");
  TORCH_CHECK(x.dim() >= 2 && x.sizes() == y.sizes(), "photometric_loss: x and y must be [...,H,W] and alike, got ",
              x.sizes(), " and ", y.sizes());
  const int64_t height = x.size(-2), width = x.size(-1);
  const int64_t lost = weights.valid ? 10 : 0, most = std::numeric_limits<int>::max();
  TORCH_CHECK(x.numel() > 0 && height > lost && width > lost, "photometric_loss: the image ", x.sizes(),
              " is too small");
  const int64_t planes = x.numel() / (height * width);
  // Limits of a launch: planes and rows of tiles.
  TORCH_CHECK(planes <= 65535 && height <= 65535 * 32 && width <= most / 2, "photometric_loss: the image ", x.sizes(),
              " is too large");
  return {x.const_data_ptr<float>(), y.const_data_ptr<float>(), int(planes), int(height), int(width),
          weights.valid, weights.l1, weights.ssim, 0., nullptr};
}

// [3]: offset + weighted sum, L1, SSIM; and what the backward pass needs (empty unless with_grad).
std::tuple<at::Tensor, at::Tensor> photometric_means(const at::Tensor& x, const at::Tensor& y, const Weights& weights,
                                                     bool with_grad) {
  kernels::Photometric args = photometric_args(x, y, weights);
  const c10::cuda::CUDAGuard guard(x.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto real = x.options().requires_grad(false);
  const at::Tensor means = at::empty({3}, real);
  const at::Tensor sums = at::empty({2 + 2 * kernels::photometric_blocks(args)}, real);  // a counter, and each block's
  at::Tensor slopes = at::empty({with_grad ? 3 * x.numel() : 0}, real);
  args.offset = weights.offset;
  args.slopes = with_grad ? slopes.mutable_data_ptr<float>() : nullptr;
  C10_CUDA_CHECK(cudaMemsetAsync(sums.data_ptr(), 0, sizeof(float2), stream));
  auto* const places = static_cast<float2*>(sums.data_ptr());
  kernels::photometric(args, {reinterpret_cast<unsigned*>(places), places + 1}, means.mutable_data_ptr<float>(),
                       stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return {means, slopes};
}

at::Tensor photometric_backward(const at::Tensor& x, const at::Tensor& y, const at::Tensor& slopes,
                                const at::Tensor& scale, const Weights& weights) {
  kernels::Photometric args = photometric_args(x, y, weights);
  check(scale, "photometric_loss", "the gradient of the loss");
  const c10::cuda::CUDAGuard guard(x.device());
  args.slopes = slopes.mutable_data_ptr<float>();
  at::Tensor grad = at::empty_like(x);
  kernels::photometric_backward(args, scale.const_data_ptr<float>(), grad.mutable_data_ptr<float>(),
                                c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return grad;
}

// The loss as a node of autograd: its gradient is put together when its scale is known.
struct PhotometricLoss : torch::autograd::Function<PhotometricLoss> {
  static torch::autograd::variable_list forward(torch::autograd::AutogradContext* ctx, const at::Tensor& x,
                                                const at::Tensor& y, const Weights& weights, bool with_grad) {
    const at::AutoDispatchBelowADInplaceOrView plain;
    const at::Tensor image = x.contiguous(), target = y.contiguous();
    auto [means, slopes] = photometric_means(image, target, weights, with_grad);
    const at::Tensor total = means.select(0, 0), l1 = means.select(0, 1), similarity = means.select(0, 2);
    ctx->mark_non_differentiable({l1, similarity});
    ctx->set_materialize_grads(false);
    ctx->save_for_backward({image, target, slopes});
    ctx->saved_data["weights"] = std::vector<double>{double(weights.valid), weights.l1, weights.ssim};
    return {total, l1, similarity};
  }

  static torch::autograd::variable_list backward(torch::autograd::AutogradContext* ctx,
                                                 const torch::autograd::variable_list& grads) {
    TORCH_CHECK(!at::GradMode::is_enabled(),
                "photometric_loss: its gradient cannot be differentiated again on CUDA (create_graph=True)");
    const at::AutoDispatchBelowADInplaceOrView plain;
    torch::autograd::variable_list out(4);  // of x; none of y, of the weights, of with_grad
    if (!grads[0].defined()) return out;
    const auto saved = ctx->get_saved_variables();
    const auto weights = ctx->saved_data["weights"].toDoubleVector();
    out[0] = photometric_backward(saved[0], saved[1], saved[2], grads[0].contiguous(),
                                  {weights[0] != 0, weights[1], weights[2], 0.});
    return out;
  }
};

std::tuple<at::Tensor, at::Tensor, at::Tensor> photometric_loss(const at::Tensor& x, const at::Tensor& y, bool valid,
                                                                double l1_weight, double ssim_weight, double offset) {
  TORCH_CHECK(!at::GradMode::is_enabled() || !y.requires_grad(), "photometric_loss: no gradient is made of y");
  const bool with_grad = at::GradMode::is_enabled() && x.requires_grad();
  const auto out = PhotometricLoss::apply(x, y, Weights{valid, l1_weight, ssim_weight, offset}, with_grad);
  return {out[0], out[1], out[2]};
}

// exp and sigmoid of a model's raw parameters as one node of autograd.
struct Activate : torch::autograd::Function<Activate> {
  static torch::autograd::variable_list forward(torch::autograd::AutogradContext* ctx, const at::Tensor& log_scales,
                                                const at::Tensor& logits) {
    const at::AutoDispatchBelowADInplaceOrView plain;
    const c10::cuda::CUDAGuard guard(log_scales.device());
    const at::Tensor from_scales = log_scales.contiguous(), from_logits = logits.contiguous();
    check(from_scales, "activate", "log_scales");
    check(from_logits, "activate", "opacity_logits");
    TORCH_CHECK(logits.device() == log_scales.device(), "activate: the tensors are on different GPUs");
    const at::Tensor scales = at::empty_like(from_scales), opacities = at::empty_like(from_logits);
    kernels::activate({from_scales.const_data_ptr<float>(), scales.numel(), from_logits.const_data_ptr<float>(),
                       opacities.numel()},
                      scales.mutable_data_ptr<float>(), opacities.mutable_data_ptr<float>(),
                      c10::cuda::getCurrentCUDAStream());
    C10_CUDA_KERNEL_LAUNCH_CHECK();
    ctx->set_materialize_grads(false);
    ctx->save_for_backward({scales, opacities});
    return {scales, opacities};
  }

  static torch::autograd::variable_list backward(torch::autograd::AutogradContext* ctx,
                                                 const torch::autograd::variable_list& grads) {
    TORCH_CHECK(!at::GradMode::is_enabled(),
                "activate: gradients cannot be differentiated again on CUDA (create_graph=True)");
    const at::AutoDispatchBelowADInplaceOrView plain;
    const auto saved = ctx->get_saved_variables();
    const c10::cuda::CUDAGuard guard(saved[0].device());
    torch::autograd::variable_list out(2);
    const float* given[2] = {nullptr, nullptr};
    float* made[2] = {nullptr, nullptr};
    at::Tensor whole[2];
    int64_t counts[2] = {0, 0};
    for (const int i : {0, 1}) {
      if (!grads[size_t(i)].defined() || !ctx->needs_input_grad(size_t(i))) continue;
      whole[i] = grads[size_t(i)].contiguous();
      out[size_t(i)] = at::empty_like(saved[size_t(i)]);
      given[i] = whole[i].const_data_ptr<float>(), made[i] = out[size_t(i)].mutable_data_ptr<float>();
      counts[i] = whole[i].numel();
    }
    const kernels::Activations activated{saved[0].const_data_ptr<float>(), counts[0], saved[1].const_data_ptr<float>(),
                                         counts[1]};
    kernels::activate_backward(activated, given[0], given[1], made[0], made[1], c10::cuda::getCurrentCUDAStream());
    C10_CUDA_KERNEL_LAUNCH_CHECK();
    return out;
  }
};

std::tuple<at::Tensor, at::Tensor> activate(const at::Tensor& log_scales, const at::Tensor& opacity_logits) {
  const auto out = Activate::apply(log_scales, opacity_logits);
  return {out[0], out[1]};
}

// One step of many tensors, in one launch. Returns the places of those that the kernel cannot take: they are left as
// they were.
std::vector<int64_t> adam_many(const std::vector<at::Tensor>& params, const std::vector<at::Tensor>& grads,
                               const std::vector<at::Tensor>& exp_avgs, const std::vector<at::Tensor>& exp_avg_sqs,
                               at::ArrayRef<double> lrs, at::ArrayRef<double> beta1s, at::ArrayRef<double> beta2s,
                               at::ArrayRef<double> epss, at::IntArrayRef steps) {
  const size_t count =
      splatwizard::adam_count(params, {&grads, &exp_avgs, &exp_avg_sqs}, {lrs, beta1s, beta2s, epss}, steps);
  std::vector<int64_t> left;
  if (count == 0) return left;
  const c10::cuda::CUDAGuard guard(params[0].device());
  std::vector<kernels::AdamTensor> tensors;
  tensors.reserve(count);
  for (size_t i = 0; i < count; ++i) {
    if (!splatwizard::fits_adam(params[0].device(), 16, steps[i],
                                {&params[i], &grads[i], &exp_avgs[i], &exp_avg_sqs[i]})) {
      left.push_back(int64_t(i));
      continue;
    }
    const double t = static_cast<double>(steps[i]);
    tensors.push_back({params[i].mutable_data_ptr<float>(), grads[i].const_data_ptr<float>(),
                       exp_avgs[i].mutable_data_ptr<float>(), exp_avg_sqs[i].mutable_data_ptr<float>(),
                       params[i].numel(), static_cast<float>(lrs[i] / (1. - std::pow(beta1s[i], t))),
                       static_cast<float>(1. - beta1s[i]), static_cast<float>(beta2s[i]),
                       static_cast<float>(1. - beta2s[i]),
                       static_cast<float>(1. / std::sqrt(1. - std::pow(beta2s[i], t))),
                       static_cast<float>(epss[i]), 0});
  }
  for (size_t first = 0; first < tensors.size(); first += kernels::kAdamTensors)
    kernels::adam(tensors.data() + first, int(std::min<size_t>(kernels::kAdamTensors, tensors.size() - first)),
                  c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  splatwizard::count_versions(params);
  return left;
}

}  // namespace

TORCH_LIBRARY(splatwizard_training, m) {
  // Differentiable: offset + weighted sum, L1, SSIM, none of which the host waits for.
  m.def("photometric_loss(Tensor x, Tensor y, bool valid, float l1_weight, float ssim_weight, float offset)"
        " -> (Tensor total, Tensor l1, Tensor similarity)");
  m.def("activate(Tensor log_scales, Tensor opacity_logits) -> (Tensor scales, Tensor opacities)");
  m.def("adam_many(Tensor(a!)[] params, Tensor[] grads, Tensor(b!)[] exp_avgs, Tensor(c!)[] exp_avg_sqs, float[] lrs,"
        " float[] beta1s, float[] beta2s, float[] epss, int[] steps) -> int[]");
}

TORCH_LIBRARY_IMPL(splatwizard_training, CUDA, m) {
  m.impl("adam_many", adam_many);
}

TORCH_LIBRARY_IMPL(splatwizard_training, CompositeImplicitAutograd, m) {
  m.impl("photometric_loss", photometric_loss);
  m.impl("activate", activate);
}

#endif  // SW_WITH_CUDA
