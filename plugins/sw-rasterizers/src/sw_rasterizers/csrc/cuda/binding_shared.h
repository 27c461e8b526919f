// The arguments of the CUDA ops of shared colours, checked.
#pragma once

#include <ATen/core/Tensor.h>

#include <limits>

#include "binding.h"
#include "../shared_colors.h"

namespace sw {

struct SharedInputs {
  const Tensor& means;
  const OptionalTensor& dc;
  const Tensor &codebook, &rows, &center;
  int64_t degree;
  bool clamp;

  void check(const char* name, const Tensor& t, at::IntArrayRef shape, at::ScalarType type) const {
    TORCH_CHECK(t.is_contiguous() && t.sizes() == shape && t.scalar_type() == type && t.device() == means.device(),
                "sw_rasterizers: ", name, " must be a contiguous tensor ", shape, " of ", type, " on ", means.device(),
                ", got ", t.sizes(), " of ", t.scalar_type(), " on ", t.device());
  }

  void check_all() const {
    const auto type = means.scalar_type();
    TORCH_CHECK(type == at::kFloat, "sw_rasterizers: on CUDA means must be float32, got ", type);
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

  void check_backward(const Tensor& order, const Tensor& offsets, const Tensor& gradient) const {
    const int64_t n = means.size(0);
    check("order", order, {n}, at::kLong);
    check("offsets", offsets, {codebook.size(0) + 1}, at::kLong);
    check("gradient", gradient, {n, 3}, means.scalar_type());
  }

  template <class S>
  SharedColors<S> of() const {
    return {means.size(0),     codebook.size(0),     data<S>(means),        data<S>(dc),     data<S>(codebook),
            3 * codebook.size(1), int(dc.has_value()), data<int64_t>(rows), data<S>(center), int(degree),
            clamp};
  }
};

}  // namespace sw
