// The ops shared_colors and shared_colors_backward on CUDA; cuda/shared_colors.cu does the work. Compiled only where
// there is CUDA.
#ifdef SW_WITH_CUDA

#include <ATen/ops/empty.h>
#include <ATen/ops/zeros.h>
#include <c10/cuda/CUDAException.h>
#include <c10/cuda/CUDAGuard.h>
#include <c10/cuda/CUDAStream.h>
#include <torch/library.h>

#include <tuple>

#include "binding_shared.h"
#include "shared_colors.h"

namespace {

using namespace sw;  // NOLINT: one file

Tensor shared_colors(const Tensor& means, const OptionalTensor& dc, const Tensor& codebook, const Tensor& rows,
                     const Tensor& center, int64_t degree, bool clamp) {
  const SharedInputs in{means, dc, codebook, rows, center, degree, clamp};
  in.check_all();
  const c10::cuda::CUDAGuard guard(means.device());
  Tensor colors = at::empty(means.sizes(), means.options().requires_grad(false));
  if (means.size(0) > 0)
    sw::cuda::shade_shared(in.of<float>(), data<float>(colors), c10::cuda::getCurrentCUDAStream());
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return colors;
}

std::tuple<Tensor, Tensor, Tensor> shared_colors_backward(const Tensor& means, const OptionalTensor& dc,
                                                          const Tensor& codebook, const Tensor& rows,
                                                          const Tensor& center, int64_t degree, bool clamp,
                                                          const Tensor& order, const Tensor& offsets,
                                                          const Tensor& gradient) {
  const SharedInputs in{means, dc, codebook, rows, center, degree, clamp};
  in.check_all();
  in.check_backward(order, offsets, gradient);
  const c10::cuda::CUDAGuard guard(means.device());
  const cudaStream_t stream = c10::cuda::getCurrentCUDAStream();
  const auto real = means.options().requires_grad(false);
  const int64_t n = means.size(0);
  Tensor of_codebook = at::zeros(codebook.sizes(), real), of_means = at::empty(means.sizes(), real);
  Tensor of_dc = at::empty(dc.has_value() ? dc->sizes() : at::IntArrayRef{0}, real);
  if (n > 0) {
    const auto shared = in.of<float>();
    const Tensor passed = at::empty(means.sizes(), real);
    const Tensor carried = at::empty({(n + cuda::kRunUsers - 1) / cuda::kRunUsers, cuda::kEntryFloats}, real);
    cuda::shade_shared_backward(shared, data<float>(gradient), data<float>(passed), data<float>(of_means),
                                data<float>(of_dc), stream);
    cuda::add_to_codebook(shared, data<int64_t>(order), data<int64_t>(offsets), data<float>(passed),
                          data<float>(of_codebook), data<float>(carried), stream);
  }
  C10_CUDA_KERNEL_LAUNCH_CHECK();
  return {of_codebook, of_dc, of_means};
}

}  // namespace

TORCH_LIBRARY_FRAGMENT(sw_rasterizers, m) {
  // rows [N] int64 below M, which the caller has checked; order [N] and offsets [M+1]: the users of each entry.
  m.def(
      "shared_colors(Tensor means, Tensor? dc, Tensor codebook, Tensor rows, Tensor center, int degree, bool clamp) "
      "-> Tensor");
  m.def(
      "shared_colors_backward(Tensor means, Tensor? dc, Tensor codebook, Tensor rows, Tensor center, int degree, "
      "bool clamp, Tensor order, Tensor offsets, Tensor gradient) -> (Tensor codebook, Tensor dc, Tensor means)");
}

TORCH_LIBRARY_IMPL(sw_rasterizers, CUDA, m) {
  m.impl("shared_colors", shared_colors);
  m.impl("shared_colors_backward", shared_colors_backward);
}

#endif  // SW_WITH_CUDA
