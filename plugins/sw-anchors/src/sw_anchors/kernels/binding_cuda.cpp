// The kernels on CUDA as torch ops, on the current stream. Compiled only where there is CUDA.
#ifdef SW_WITH_CUDA

#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include "binding.h"
#include "cuda/kernels.h"

namespace {

using namespace sw_anchors;

std::vector<Tensor> spawn(const Tensor& alpha, const Tensor& geometry, const Tensor& color, const Tensor& positions,
                          const Tensor& offsets, const Tensor& scales, const std::optional<Tensor>& masks,
                          const Tensor& drawn) {
  const Arguments given{alpha, geometry, color, positions, offsets, scales, masks, drawn};
  const Anchors from = given.checked();
  const c10::cuda::CUDAGuard guard(alpha.device());
  Spawned found(from.count, alpha);
  sw_anchors::cuda::spawn(from, found.at, c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found.tensors;
}

std::vector<Tensor> spawn_backward(const Tensor& alpha, const Tensor& geometry, const Tensor& color,
                                   const Tensor& positions, const Tensor& offsets, const Tensor& scales,
                                   const std::optional<Tensor>& masks, const Tensor& drawn,
                                   const std::vector<Tensor>& slopes, bool with_positions, bool ordered) {
  const Arguments given{alpha, geometry, color, positions, offsets, scales, masks, drawn};
  const Anchors from = given.checked();
  const Gaussians by = slopes_of(slopes, given);
  const c10::cuda::CUDAGuard guard(alpha.device());
  Dense found(from, masks.has_value(), with_positions, alpha);
  sw_anchors::cuda::spawn_backward(from, by, found.at, ordered, c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return found.tensors;
}

}  // namespace

TORCH_LIBRARY(sw_anchors, m) {
  m.def("spawn(Tensor alpha, Tensor geometry, Tensor color, Tensor positions, Tensor offsets, Tensor scales,"
        " Tensor? masks, Tensor drawn) -> Tensor[]");
  // ordered: sums of an anchor's Gaussians have one order.
  m.def("spawn_backward(Tensor alpha, Tensor geometry, Tensor color, Tensor positions, Tensor offsets, Tensor scales,"
        " Tensor? masks, Tensor drawn, Tensor[] slopes, bool with_positions, bool ordered=False) -> Tensor[]");
}

TORCH_LIBRARY_IMPL(sw_anchors, CUDA, m) {
  m.impl("spawn", spawn);
  m.impl("spawn_backward", spawn_backward);
}

#endif  // SW_WITH_CUDA
