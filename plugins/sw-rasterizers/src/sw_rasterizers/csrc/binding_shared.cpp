// The ops shared_colors and shared_colors_backward: memory, types and shapes; cpu/shared_colors.cpp does the work.
#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <torch/library.h>

#include <limits>
#include <tuple>

#include "binding_memory.h"
#include "cpu/shared_colors.h"

namespace {

using namespace sw;  // NOLINT: one file
using OptionalTensor = std::optional<Tensor>;

template <class S>
S* data(const Tensor& t) {
  return t.defined() && t.numel() > 0 ? static_cast<S*>(t.data_ptr()) : nullptr;
}

void check(const char* name, const Tensor& t, at::IntArrayRef shape, at::ScalarType type) {
  TORCH_CHECK(t.is_contiguous() && t.sizes() == shape && t.scalar_type() == type && t.device().is_cpu(),
              "sw_rasterizers: ", name, " must be a contiguous CPU tensor ", shape, " of ", type, ", got ", t.sizes(),
              " of ", t.scalar_type());
}

struct SharedInputs {
  const Tensor& means;
  const OptionalTensor& dc;
  const Tensor &codebook, &rows, &center;
  int64_t degree;
  bool clamp;

  void check_all() const {
    const auto type = means.scalar_type();
    TORCH_CHECK(type == at::kFloat || type == at::kDouble, "sw_rasterizers: means must be float32 or float64, got ",
                type);
    TORCH_CHECK(means.dim() == 2 && codebook.dim() == 3, "sw_rasterizers: means must be [N,3], codebook [M,K,3]");
    const int64_t n = means.size(0), basis = (degree + 1) * (degree + 1);
    check("means", means, {n, 3}, type);
    check("codebook", codebook, {codebook.size(0), codebook.size(1), 3}, type);
    check("rows", rows, {n}, at::kLong);
    check("center", center, {3}, type);
    if (dc.has_value()) check("dc", *dc, {n, 1, 3}, type);
    TORCH_CHECK(degree >= 0 && degree <= 3 && codebook.size(1) + int(dc.has_value()) >= basis,
                "sw_rasterizers: SH degree ", degree, " needs ", basis, " coefficients");
    const int64_t most = std::numeric_limits<int32_t>::max();
    TORCH_CHECK(n < most && codebook.size(0) < most, "sw_rasterizers: more than 2^31 - 1 Gaussians or entries");
  }

  template <class S>
  SharedColors<S> of() const {
    return {means.size(0),        codebook.size(0),        data<S>(means), dc.has_value() ? data<S>(*dc) : nullptr,
            data<S>(codebook),    3 * codebook.size(1),    int(dc.has_value()), data<int64_t>(rows),
            data<S>(center),      int(degree),             clamp,          at::get_num_threads()};
  }
};

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
  const int64_t n = means.size(0);
  check("order", order, {n}, at::kLong);
  check("offsets", offsets, {codebook.size(0) + 1}, at::kLong);
  check("gradient", gradient, {n, 3}, means.scalar_type());
  const auto real = means.options().requires_grad(false);
  Tensor of_codebook = make_tensor(codebook.sizes(), real), of_means = make_tensor(means.sizes(), real);
  Tensor of_dc = make_tensor(dc.has_value() ? dc->sizes() : at::IntArrayRef{0}, real);
  if (n == 0)
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
