// Bits of a sample of anchors under predicted distributions, and inputs of the networks of channels, as torch ops on
// CUDA, on the current stream. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <optional>
#include <vector>

#include "cuda/mixture.h"

namespace {

using namespace sw_hac;
using at::Tensor;

void check(const Tensor& t, const char* name, const Tensor& like, at::IntArrayRef shape,
           at::ScalarType type = at::kFloat) {
  TORCH_CHECK(t.scalar_type() == type && t.is_contiguous() && t.device() == like.device() && t.sizes() == shape,
              "sw_hac: ", name, " must be contiguous ", type, " ", shape, " on ", like.device(), ", got ",
              t.toString(), " ", t.sizes(), " on ", t.device());
}

const float* floats(const Tensor& t, const char* name, const Tensor& like, at::IntArrayRef shape) {
  check(t, name, like, shape);
  return t.const_data_ptr<float>();
}

float* room(std::vector<Tensor>& found, const Tensor& like, at::IntArrayRef shape) {
  found.push_back(at::empty(shape, like.options().requires_grad(false)));
  return found.back().mutable_data_ptr<float>();
}

// Bits, derivatives by x, outputs, steps, masks and, if there is one, second. `kind` is a MaskKind.
std::vector<Tensor> mixture_bits(const Tensor& x, const Tensor& outputs, const Tensor& units,
                                 const std::optional<Tensor>& second, const std::optional<Tensor>& columns,
                                 const Tensor& steps, const Tensor& masks, const Tensor& counted, double base,
                                 double smallest, double smallest_scale, double scale_floor, int64_t kind) {
  TORCH_CHECK(x.is_cuda() && x.dim() == 2 && masks.dim() == 2 && outputs.dim() == 2,
              "sw_hac: x must be [s,numbers], masks [s,k], outputs [s,width]");
  TORCH_CHECK(second.has_value() == columns.has_value(), "sw_hac: a second Gaussian needs its columns");
  TORCH_CHECK(kAlone <= kind && kind <= kGatedMean, "sw_hac: there is no kind ", kind, " of masks");
  const int64_t s = x.size(0), k = masks.size(1), numbers = x.size(1), f = numbers - 6 - 3 * k, width = outputs.size(1);
  TORCH_CHECK(f >= 0, "sw_hac: ", numbers, " numbers are too few for ", k, " offsets");
  TORCH_CHECK(width >= 2 * numbers + (second.has_value() ? f : 0), "sw_hac: ", width, " outputs are too few for ",
              numbers, " numbers");
  Mixture from{};
  from.count = s, from.features = int(f), from.offsets = int(k), from.width = int(width);
  from.x = floats(x, "x", x, {s, numbers});
  from.outputs = floats(outputs, "outputs", x, {s, width});
  from.units = floats(units, "units", x, {width});
  from.steps = floats(steps, "steps", x, {s, 3});
  from.masks = floats(masks, "masks", x, {s, k});
  from.counted = floats(counted, "counted", x, {s});
  from.base = float(base), from.kind = MaskKind(kind);
  from.bounds = {float(smallest), float(smallest_scale), float(scale_floor)};
  std::vector<Tensor> found;
  MixtureSlopes to{};
  to.bits = room(found, x, {s, 3}), to.x = room(found, x, {s, numbers}), to.outputs = room(found, x, {s, width});
  to.steps = room(found, x, {s, 3}), to.masks = room(found, x, {s, k});
  if (second.has_value()) {
    from.second = floats(*second, "second", x, {s, 3 * f});
    check(*columns, "columns", x, {3, f}, at::kInt);
    from.columns = columns->const_data_ptr<int>();
    to.second = room(found, x, {s, 3 * f});
  }
  const c10::cuda::CUDAGuard guard(x.device());
  cuda::mixture_bits(from, to, c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

Channels channels_of(const Tensor& x, const Tensor& outputs, const Tensor& units, int64_t features, double base,
                     bool context) {
  TORCH_CHECK(x.dim() == 2 && outputs.dim() == 2, "sw_hac: x must be [s,numbers], outputs [s,width]");
  const int64_t numbers = x.size(1), width = outputs.size(1), taken = features * (context ? 4 : 1);
  TORCH_CHECK(0 < features && features <= numbers && 3 * features <= width, "sw_hac: ", features,
              " features do not fit ", numbers, " numbers and ", width, " outputs");
  Channels of{};
  of.count = x.size(0), of.features = int(features), of.numbers = int(numbers), of.width = int(width);
  of.inputs = int(taken / 4 * 4 + 4);  // a column of ones, then zeros
  of.units = floats(units, "units", x, {width});
  of.base = float(base), of.context = context;
  return of;
}

Tensor channel_inputs(const Tensor& x, const Tensor& outputs, const Tensor& units, int64_t features, double base,
                      bool context) {
  const Channels of = channels_of(x, outputs, units, features, base, context);
  const float* const from_x = floats(x, "x", x, {of.count, of.numbers});
  const float* const from_outputs = floats(outputs, "outputs", x, {of.count, of.width});
  std::vector<Tensor> found;
  float* const to = room(found, x, {of.count, of.inputs});
  const c10::cuda::CUDAGuard guard(x.device());
  cuda::channel_inputs(of, from_x, from_outputs, to, c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found[0];
}

std::vector<Tensor> channel_slopes(const Tensor& slope, const Tensor& by_x, const Tensor& by_outputs,
                                   const std::optional<Tensor>& by_inputs, const Tensor& units, int64_t features,
                                   double base, bool context) {
  const Channels of = channels_of(by_x, by_outputs, units, features, base, context);
  ChannelSlopes by{};
  by.slope = floats(slope, "slope", by_x, {});
  by.x = floats(by_x, "derivative by x", by_x, {of.count, of.numbers});
  by.outputs = floats(by_outputs, "derivative by outputs", by_x, {of.count, of.width});
  if (by_inputs.has_value()) by.inputs = floats(*by_inputs, "derivative by inputs", by_x, {of.count, of.inputs});
  std::vector<Tensor> found;
  float* const to_x = room(found, by_x, {of.count, of.numbers});
  float* const to_outputs = room(found, by_x, {of.count, of.width});
  const c10::cuda::CUDAGuard guard(by_x.device());
  cuda::channel_slopes(of, by, to_x, to_outputs, c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found;
}

}  // namespace

TORCH_LIBRARY(sw_hac, m) {
  m.def("mixture_bits(Tensor x, Tensor outputs, Tensor units, Tensor? second, Tensor? columns, Tensor steps,"
        " Tensor masks, Tensor counted, float base, float smallest, float smallest_scale, float scale_floor, int kind)"
        " -> Tensor[]");
  m.def("channel_inputs(Tensor x, Tensor outputs, Tensor units, int features, float base, bool context) -> Tensor");
  m.def("channel_slopes(Tensor slope, Tensor by_x, Tensor by_outputs, Tensor? by_inputs, Tensor units, int features,"
        " float base, bool context) -> Tensor[]");
}

TORCH_LIBRARY_IMPL(sw_hac, CUDA, m) {
  m.impl("mixture_bits", mixture_bits);
  m.impl("channel_inputs", channel_inputs);
  m.impl("channel_slopes", channel_slopes);
}

#endif  // SW_WITH_CUDA
