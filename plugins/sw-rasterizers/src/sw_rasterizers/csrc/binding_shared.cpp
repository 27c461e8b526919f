// The ops shared_colors and shared_colors_backward: memory, types and shapes; cpu/shared_colors.cpp does the work.
#include <torch/library.h>

#include <tuple>

#include "binding_memory.h"
#include "binding_shared.h"
#include "cpu/shared_colors.h"

namespace {

using namespace sw;  // NOLINT: one file

Tensor shared_colors(const Tensor& means, const OptionalTensor& dc, const Tensor& codebook, const Tensor& rows,
                     const Tensor& center, int64_t degree, bool clamp) {
  const SharedInputs in{means, dc, codebook, rows, center, degree, clamp};
  in.check_all();
  Tensor colors = make_tensor(means.sizes(), means.options().requires_grad(false));
  if (means.size(0) == 0) return colors;
  if (means.scalar_type() == at::kDouble)
    SW_SELECT(shade_shared<double>)(in.of<double>(), data<double>(colors));
  else
    SW_SELECT(shade_shared<float>)(in.of<float>(), data<float>(colors));
  return colors;
}

template <class S>
void backward_as(const SharedInputs& in, const Tensor& order, const Tensor& offsets, const Tensor& gradient,
                 Tensor& codebook, Tensor& dc, Tensor& means) {
  const Tensor passed = make_tensor(means.sizes(), means.options());
  const auto shared = in.of<S>();
  SW_SELECT(shade_shared_backward<S>)(shared, data<S>(gradient), data<S>(passed), data<S>(means), data<S>(dc));
  SW_SELECT(add_to_codebook<S>)(shared, data<int64_t>(order), data<int64_t>(offsets), data<S>(passed),
                                data<S>(codebook));
}

std::tuple<Tensor, Tensor, Tensor> shared_colors_backward(const Tensor& means, const OptionalTensor& dc,
                                                          const Tensor& codebook, const Tensor& rows,
                                                          const Tensor& center, int64_t degree, bool clamp,
                                                          const Tensor& order, const Tensor& offsets,
                                                          const Tensor& gradient) {
  const SharedInputs in{means, dc, codebook, rows, center, degree, clamp};
  in.check_all();
  in.check_backward(order, offsets, gradient);
  const auto real = means.options().requires_grad(false);
  Tensor of_codebook = make_tensor(codebook.sizes(), real), of_means = make_tensor(means.sizes(), real);
  Tensor of_dc = make_tensor(dc.has_value() ? dc->sizes() : at::IntArrayRef{0}, real);
  if (means.size(0) == 0)
    of_codebook.zero_();
  else if (means.scalar_type() == at::kDouble)
    backward_as<double>(in, order, offsets, gradient, of_codebook, of_dc, of_means);
  else
    backward_as<float>(in, order, offsets, gradient, of_codebook, of_dc, of_means);
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

TORCH_LIBRARY_IMPL(sw_rasterizers, CPU, m) {
  m.impl("shared_colors", shared_colors);
  m.impl("shared_colors_backward", shared_colors_backward);
}
