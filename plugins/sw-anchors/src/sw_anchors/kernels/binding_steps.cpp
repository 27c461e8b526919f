// Registers the ops of predicted quantiser steps, on the CPU.
#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <torch/library.h>

#include <splatwizard/torch_parallel.h>

#include <vector>

#include "checked.h"
#include "kernels.h"

namespace {

using namespace sw_anchors;
using at::Tensor;

// `parameters`: weight and bias of the first layer, then of the last one.
StepNetwork network_of(const Tensor& features, const std::vector<Tensor>& parameters, const Tensor& base, double offset,
                       double smallest) {
  TORCH_CHECK(features.dim() == 2 && parameters.size() == 4 && parameters[0].dim() == 2,
              "sw_anchors: features must be [n, inputs], a network of two layers is needed");
  StepNetwork of{};
  of.count = features.size(0), of.inputs = features.size(1), of.hidden = parameters[0].size(0);
  of.features = floats(features, "features", {of.count, of.inputs});
  of.first = floats(parameters[0], "weights", {of.hidden, of.inputs});
  of.first_bias = floats(parameters[1], "biases", {of.hidden});
  of.last = floats(parameters[2], "weights of steps", {3, of.hidden});
  of.last_bias = floats(parameters[3], "biases of steps", {3});
  of.base = floats(base, "base steps", {3});
  of.offset = float(offset), of.smallest = float(smallest);
  return of;
}

// Steps [n,3], the hidden layer [n, hidden], tangents [n,3] for the gradient.
std::vector<Tensor> predicted_steps(const Tensor& features, const std::vector<Tensor>& parameters, const Tensor& base,
                                    double offset, double smallest) {
  const StepNetwork of = network_of(features, parameters, base, offset, smallest);
  const auto real = features.options().requires_grad(false);
  const Tensor steps = at::empty({of.count, 3}, real), tangents = at::empty({of.count, 3}, real),
               hidden = at::empty({of.count, of.hidden}, real);
  SW_SELECT(predicted_steps)(of, hidden.data_ptr<float>(), tangents.data_ptr<float>(), steps.data_ptr<float>(),
                             splatwizard::torch_parallel());
  return {steps, hidden, tangents};
}

// Gradients of the features and of the four parameters.
std::vector<Tensor> predicted_steps_backward(const Tensor& features, const std::vector<Tensor>& parameters,
                                             const Tensor& base, double offset, double smallest, const Tensor& hidden,
                                             const Tensor& tangents, const Tensor& to_steps, const Tensor& to_hidden) {
  const StepNetwork of = network_of(features, parameters, base, offset, smallest);
  const auto real = features.options().requires_grad(false);
  std::vector<Tensor> found = {at::empty(features.sizes(), real)};
  for (const Tensor& parameter : parameters) found.push_back(at::empty(parameter.sizes(), real));
  const auto at = [&](int i) { return found[i].data_ptr<float>(); };
  SW_SELECT(predicted_steps_backward)(
      of, floats(hidden, "hidden layer", {of.count, of.hidden}), floats(tangents, "tangents", {of.count, 3}),
      floats(to_steps, "gradient of steps", {of.count, 3}),
      floats(to_hidden, "gradient of the hidden layer", {of.count, of.hidden}), {at(0), at(1), at(2), at(3), at(4)},
      splatwizard::torch_parallel());
  return found;
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_anchors, m) {
  m.def("predicted_steps(Tensor features, Tensor[] parameters, Tensor base, float offset, float smallest) -> Tensor[]");
  m.def("predicted_steps_backward(Tensor features, Tensor[] parameters, Tensor base, float offset, float smallest,"
        " Tensor hidden, Tensor tangents, Tensor to_steps, Tensor to_hidden) -> Tensor[]");
  m.impl("predicted_steps", c10::DispatchKey::CPU, TORCH_FN(predicted_steps));
  m.impl("predicted_steps_backward", c10::DispatchKey::CPU, TORCH_FN(predicted_steps_backward));
}
