// Registers the ops of anchors, and their kernels on the CPU.
#include <torch/library.h>

#include <splatwizard/torch_parallel.h>

#include "binding.h"
#include "kernels.h"

namespace {

using namespace sw_anchors;

std::vector<Tensor> spawn(const Tensor& alpha, const Tensor& geometry, const Tensor& color, const Tensor& positions,
                          const Tensor& offsets, const Tensor& scales, const std::optional<Tensor>& masks,
                          const Tensor& drawn) {
  const Arguments given{alpha, geometry, color, positions, offsets, scales, masks, drawn};
  const Anchors from = given.checked();
  Spawned found(from.count, alpha);
  SW_SELECT(spawn)(from, found.at, splatwizard::torch_parallel());
  return found.tensors;
}

std::vector<Tensor> spawn_backward(const Tensor& alpha, const Tensor& geometry, const Tensor& color,
                                   const Tensor& positions, const Tensor& offsets, const Tensor& scales,
                                   const std::optional<Tensor>& masks, const Tensor& drawn,
                                   const std::vector<Tensor>& slopes, bool with_positions, bool /*ordered*/) {
  const Arguments given{alpha, geometry, color, positions, offsets, scales, masks, drawn};
  const Anchors from = given.checked();
  const Gaussians by = slopes_of(slopes, given);
  Dense found(from, masks.has_value(), with_positions, alpha);
  SW_SELECT(spawn_backward)(from, by, found.at, splatwizard::torch_parallel());
  return found.tensors;
}

}  // namespace

TORCH_LIBRARY(sw_anchors, m) {
  m.def("spawn(Tensor alpha, Tensor geometry, Tensor color, Tensor positions, Tensor offsets, Tensor scales,"
        " Tensor? masks, Tensor drawn) -> Tensor[]");
  // ordered: sums of an anchor's Gaussians have one order; on a CPU they always have.
  m.def("spawn_backward(Tensor alpha, Tensor geometry, Tensor color, Tensor positions, Tensor offsets, Tensor scales,"
        " Tensor? masks, Tensor drawn, Tensor[] slopes, bool with_positions, bool ordered=False) -> Tensor[]");
  m.impl("spawn", c10::DispatchKey::CPU, TORCH_FN(spawn));
  m.impl("spawn_backward", c10::DispatchKey::CPU, TORCH_FN(spawn_backward));
}
