// Learned planes in training as torch ops, on the current stream: their bits, and the lookup in triplanes. On CUDA alone.
#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <limits>
#include <optional>
#include <tuple>
#include <vector>

#include "cuda/plane_bits.h"
#include "cuda/triplane.h"
#include "sums.h"

namespace {

using at::Tensor;

void check(const Tensor& t, const char* name, const Tensor& like) {
  TORCH_CHECK(t.scalar_type() == at::kFloat && t.is_contiguous() && t.device() == like.device(), "sw_codecs: ", name,
              " must be contiguous float32 on ", like.device(), ", got ", t.toString(), " on ", t.device());
}

// `planes` must be of one device, each [k, channels, height, width] of the same k and channels.
void check_planes(const std::vector<Tensor>& planes, size_t most) {
  TORCH_CHECK(!planes.empty() && planes.size() <= most, "sw_codecs: planes of 1 to ", most, " sizes are offered");
  for (const Tensor& plane : planes) {
    check(plane, "a plane", planes[0]);
    TORCH_CHECK(plane.dim() == 4 && plane.size(0) == planes[0].size(0) && plane.size(1) == planes[0].size(1) &&
                    plane.numel() < std::numeric_limits<int32_t>::max(),
                "sw_codecs: planes must be [k,channels,height,width] of one k and channels, got ", plane.sizes());
  }
}

std::tuple<Tensor, std::vector<Tensor>> plane_bits(const std::vector<Tensor>& planes, const Tensor& parameters,
                                                   bool planes_learn, bool ordered) {
  using namespace sw_planes;
  check_planes(planes, kScales);
  check(parameters, "parameters", planes[0]);
  const int64_t k = planes[0].size(0);
  TORCH_CHECK(parameters.dim() == 2 && parameters.size(0) == k && parameters.size(1) == kParameters,
              "sw_codecs: parameters must be [", k, ",", kParameters, "], got ", parameters.sizes());
  const c10::cuda::CUDAGuard guard(parameters.device());
  Planes at{};
  at.scales = int(planes.size()), at.orientations = int(k), at.channels = int(planes[0].size(1));
  std::vector<Tensor> to, parts_of_sums;
  const auto real = parameters.options().requires_grad(false);
  for (size_t i = 0; i < planes.size(); ++i) {
    at.height[i] = int(planes[i].size(2)), at.width[i] = int(planes[i].size(3));
    at.count[i] = int64_t(at.channels) * at.height[i] * at.width[i];
    at.values[i] = planes[i].const_data_ptr<float>();
    if (planes_learn) to.push_back(at::zeros(planes[i].sizes(), planes[i].options().requires_grad(false)));
    at.to[i] = planes_learn ? to.back().mutable_data_ptr<float>() : nullptr;
    if (planes_learn && ordered) {
      parts_of_sums.push_back(at::empty({k * part_sums(at, int(i))}, real));
      at.parts[i] = parts_of_sums.back().mutable_data_ptr<float>();
    }
  }
  const int parts = sw_planes::cuda::parts_of(at);
  Tensor partial = at::empty({k, parts, kSums}, real);
  sw_planes::cuda::bits(at, parameters.const_data_ptr<float>(), partial.mutable_data_ptr<float>(),
                        c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return {partial.sum(1), std::move(to)};
}

sw_triplane::Sites sites_of(const Tensor& cells, const Tensor& weights, const std::vector<Tensor>& planes) {
  using namespace sw_triplane;
  check_planes(planes, sw_triplane::kScales);
  check(weights, "weights", planes[0]);
  const int64_t scales = int64_t(planes.size());
  TORCH_CHECK(planes[0].size(0) == kPairs && planes[0].size(1) > 0, "sw_codecs: planes must be [3,C,H,W]");
  TORCH_CHECK(cells.scalar_type() == at::kInt && cells.is_contiguous() && cells.device() == weights.device() &&
                  cells.dim() == 4 && cells.size(1) == scales && cells.size(2) == kPairs && cells.size(3) == kCorners &&
                  weights.sizes() == cells.sizes(),
              "sw_codecs: cells must be contiguous int32 [n,", scales, ",3,4], weights likewise");
  return {cells.size(0), int(scales), int(planes[0].size(1)), cells.const_data_ptr<int32_t>(),
          weights.const_data_ptr<float>()};
}

bool in_fours(const sw_triplane::Sites& sites, const Tensor& features) {
  return sites.channels % 4 == 0 && reinterpret_cast<uintptr_t>(features.const_data_ptr()) % 16 == 0;
}

Tensor triplane_lookup(const Tensor& cells, const Tensor& weights, const std::vector<Tensor>& planes, double gain) {
  const sw_triplane::Sites sites = sites_of(cells, weights, planes);
  const c10::cuda::CUDAGuard guard(weights.device());
  const auto stream = c10::cuda::getCurrentCUDAStream();
  const auto real = weights.options().requires_grad(false);
  std::vector<Tensor> held;
  sw_triplane::cuda::Tables tables{};
  for (size_t i = 0; i < planes.size(); ++i) {
    const int64_t places = planes[i].size(2) * planes[i].size(3);
    held.push_back(at::empty({sw_triplane::kPairs * places, sites.channels}, real));
    tables.of[i] = held.back().mutable_data_ptr<float>();
    sw_triplane::cuda::transpose(planes[i].const_data_ptr<float>(), tables.of[i], sw_triplane::kPairs, sites.channels,
                                 places, float(gain), stream);
  }
  Tensor features = at::empty({sites.count, sites.scales * sw_triplane::kPairs * sites.channels}, real);
  sw_triplane::cuda::lookup(sites, in_fours(sites, features), tables, features.mutable_data_ptr<float>(), stream);
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return features;
}

std::vector<Tensor> triplane_backward(const Tensor& cells, const Tensor& weights, const Tensor& slopes,
                                      const std::vector<Tensor>& planes, const std::optional<Tensor>& largest) {
  const sw_triplane::Sites sites = sites_of(cells, weights, planes);
  check(slopes, "slopes", weights);
  TORCH_CHECK(slopes.dim() == 2 && slopes.size(0) == sites.count &&
                  slopes.size(1) == sites.scales * sw_triplane::kPairs * sites.channels,
              "sw_codecs: slopes do not fit the sites");
  const c10::cuda::CUDAGuard guard(weights.device());
  const auto stream = c10::cuda::getCurrentCUDAStream();
  const auto real = weights.options().requires_grad(false);
  const bool whole = largest.has_value();
  std::vector<Tensor> held, found;
  sw_triplane::cuda::Tables tables{};
  // A slope is that of its own scale and of all finer ones; corners may fall together.
  sw_triplane::cuda::SumTables sums{{}, whole ? sw_sums::checked_largest(*largest, weights) : nullptr,
                                    sites.count * sites.scales * sw_triplane::kCorners};
  for (size_t i = 0; i < planes.size(); ++i) {
    const int64_t rows = sw_triplane::kPairs * planes[i].size(2) * planes[i].size(3);
    held.push_back(at::zeros({rows, sites.channels}, whole ? real.dtype(at::kLong) : real));
    if (whole)
      sums.of[i] = reinterpret_cast<sw_sums::Whole*>(held.back().mutable_data_ptr<int64_t>());
    else
      tables.of[i] = held.back().mutable_data_ptr<float>();
  }
  const bool four = in_fours(sites, slopes);
  const float* from = slopes.const_data_ptr<float>();
  if (whole)
    sw_triplane::cuda::backward(sites, four, from, sums, stream);
  else
    sw_triplane::cuda::backward(sites, four, from, tables, stream);
  for (size_t i = 0; i < planes.size(); ++i) {
    found.push_back(at::empty(planes[i].sizes(), real));
    float* const to = found.back().mutable_data_ptr<float>();
    const int64_t places = planes[i].size(2) * planes[i].size(3);
    if (whole)
      sw_triplane::cuda::transpose(sw_sums::Sums{sums.of[i], sums.largest, sums.count}, to, sw_triplane::kPairs, places,
                                   sites.channels, stream);
    else
      sw_triplane::cuda::transpose(tables.of[i], to, sw_triplane::kPairs, places, sites.channels, 0.f, stream);
  }
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_codecs, m) {
  // Planes [K,C,H,W] of each scale and parameters [K,1058] -> [K,1060]: the gradients of the bits by the parameters, the
  // bits, 0; and the gradients by the planes, or none.
  // ordered: the sums of the latter have one order, in more memory; those of the former always have.
  m.def("plane_bits(Tensor[] planes, Tensor parameters, bool planes_learn, bool ordered=False) -> (Tensor, Tensor[])");
  // Features [n, scales 3 C] of planes [3,C,H,W], rounded to multiples of 1/gain where it is not 0.
  m.def("triplane_lookup(Tensor cells, Tensor weights, Tensor[] planes, float gain) -> Tensor");
  // With `largest`, which no slope exceeds, sums are the same in any order.
  m.def("triplane_backward(Tensor cells, Tensor weights, Tensor slopes, Tensor[] planes,"
        " Tensor? largest=None) -> Tensor[]");
}

TORCH_LIBRARY_IMPL(sw_codecs, CUDA, m) {
  m.impl("plane_bits", plane_bits);
  m.impl("triplane_lookup", triplane_lookup);
  m.impl("triplane_backward", triplane_backward);
}

#endif  // SW_WITH_CUDA
