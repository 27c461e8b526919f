// The three networks of anchors as torch ops, on the current stream. On CUDA alone.
#include <torch/library.h>

TORCH_LIBRARY_FRAGMENT(sw_anchors, m) {
  // parameters: weight and bias of the first layer, then of the last, of each network. Opacities after tanh [n,k], outputs
  // of the covariance and the colour network; gradients by features and parameters.
  m.def("view_networks(Tensor center, Tensor positions, Tensor features, Tensor[] parameters) -> Tensor[]");
  m.def("view_networks_backward(Tensor center, Tensor positions, Tensor features, Tensor[] parameters, Tensor alpha,"
        " Tensor[] slopes) -> Tensor[]");
}

#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>

#include <vector>

#include "cuda/networks.h"

namespace {

using at::Tensor;
using namespace sw_anchors::cuda;

void check(const Tensor& t, const char* name, const Tensor& like, at::IntArrayRef shape) {
  TORCH_CHECK(t.scalar_type() == at::kFloat && t.is_contiguous() && t.device() == like.device() && t.sizes() == shape,
              "sw_anchors: ", name, " must be contiguous float32 ", shape, " on ", like.device(), ", got ",
              t.toString(), " ", t.sizes(), " on ", t.device());
}

Viewed viewed_of(const Tensor& center, const Tensor& positions, const Tensor& features) {
  TORCH_CHECK(features.dim() == 2 && features.scalar_type() == at::kFloat && features.is_cuda() &&
                  (features.size(0) == 0 || features.stride(1) == 1),
              "sw_anchors: features must be float32 [n,f] with rows without gaps");
  check(center, "center", features, {3});
  check(positions, "positions", features, {features.size(0), 3});
  return {features.size(0), features.stride(0), center.const_data_ptr<float>(), positions.const_data_ptr<float>(),
          features.const_data_ptr<float>()};
}

Networks networks_of(const Tensor& features, const std::vector<Tensor>& parameters) {
  TORCH_CHECK(parameters.size() == size_t(kPieces) && parameters[0].dim() == 2,
              "sw_anchors: ", kPieces, " parameters of three networks are needed");
  Networks networks{};
  const int64_t inputs = features.size(1) + 4, hidden = parameters[0].size(0);
  TORCH_CHECK(inputs <= kMostInputs && hidden > 0 && hidden <= kMostHidden, "sw_anchors: networks of ", inputs,
              " inputs and ", hidden, " hidden numbers are not offered");
  networks.features = int(features.size(1)), networks.hidden = int(hidden);
  for (int n = 0; n < kNetworks; ++n) {
    const Tensor* own = parameters.data() + 4 * n;
    TORCH_CHECK(own[2].dim() == 2 && own[2].size(0) > 0 && own[2].size(0) <= kMostOutputs[n],
                "sw_anchors: too many outputs of a network");
    check(own[0], "a first weight", features, {hidden, inputs});
    check(own[1], "a first bias", features, {hidden});
    check(own[2], "a last weight", features, {own[2].size(0), hidden});
    check(own[3], "a last bias", features, {own[2].size(0)});
    networks.outputs[n] = int(own[2].size(0));
    networks.first[n] = own[0].const_data_ptr<float>(), networks.first_bias[n] = own[1].const_data_ptr<float>();
    networks.last[n] = own[2].const_data_ptr<float>(), networks.last_bias[n] = own[3].const_data_ptr<float>();
  }
  return networks;
}

std::vector<Tensor> view_networks(const Tensor& center, const Tensor& positions, const Tensor& features,
                                  const std::vector<Tensor>& parameters) {
  const Viewed viewed = viewed_of(center, positions, features);
  const Networks networks = networks_of(features, parameters);
  const c10::cuda::CUDAGuard guard(features.device());
  std::vector<Tensor> found;
  Outputs to{};
  for (int n = 0; n < kNetworks; ++n) {
    found.push_back(at::empty({viewed.count, networks.outputs[n]}, features.options().requires_grad(false)));
    to.of[n] = found.back().mutable_data_ptr<float>();
  }
  networks_forward(viewed, networks, to, c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

std::vector<Tensor> view_networks_backward(const Tensor& center, const Tensor& positions, const Tensor& features,
                                           const std::vector<Tensor>& parameters, const Tensor& alpha,
                                           const std::vector<Tensor>& slopes) {
  const Viewed viewed = viewed_of(center, positions, features);
  const Networks networks = networks_of(features, parameters);
  TORCH_CHECK(slopes.size() == size_t(kNetworks), "sw_anchors: a gradient for each network is needed");
  check(alpha, "alpha", features, {viewed.count, networks.outputs[0]});
  Outputs by{};
  for (int n = 0; n < kNetworks; ++n) {
    check(slopes[n], "a gradient", features, {viewed.count, networks.outputs[n]});
    by.of[n] = const_cast<float*>(slopes[n].const_data_ptr<float>());  // read only
  }
  const c10::cuda::CUDAGuard guard(features.device());
  const auto real = features.options().requires_grad(false);
  const Layout layout = layout_of(networks);
  Tensor to_features = at::empty({viewed.count, features.size(1)}, real);
  Tensor partial = at::empty({networks_parts(viewed.count), kPartial}, real), all = at::empty({layout.total}, real);
  networks_backward(viewed, networks, alpha.const_data_ptr<float>(), by, to_features.mutable_data_ptr<float>(),
                    partial.mutable_data_ptr<float>(), all.mutable_data_ptr<float>(),
                    c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  std::vector<Tensor> found = {to_features};
  for (int piece = 0; piece < kPieces; ++piece)
    found.push_back(all.narrow(0, layout.start[piece], parameters[piece].numel()).view(parameters[piece].sizes()));
  return found;
}

}  // namespace

TORCH_LIBRARY_IMPL(sw_anchors, CUDA, m) {
  m.impl("view_networks", view_networks);
  m.impl("view_networks_backward", view_networks_backward);
}

#endif  // SW_WITH_CUDA
