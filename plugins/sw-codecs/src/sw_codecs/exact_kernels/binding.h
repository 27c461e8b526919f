// What the binding files share: the check of their arguments.
#pragma once
#include <ATen/core/Tensor.h>

#include "kernels.h"

namespace splatwizard {

inline void check(const at::Tensor& tensor, at::ScalarType type, int64_t dims, const char* op, const char* name) {
  TORCH_CHECK(tensor.is_cpu() && tensor.scalar_type() == type && tensor.dim() == dims && tensor.is_contiguous(), op,
              ": ", name, " must be a contiguous ", type, " tensor of ", dims, " axes on the CPU, got ",
              tensor.toString(), tensor.sizes());
}

}  // namespace splatwizard
