// Tensors that the kernels of the CPU read, checked before their memory is.
#pragma once

#include <ATen/core/Tensor.h>

namespace sw_anchors {

inline const float* floats(const at::Tensor& t, const char* name, at::IntArrayRef shape) {
  TORCH_CHECK(t.scalar_type() == at::kFloat && t.is_cpu() && t.is_contiguous() && t.sizes() == shape,
              "sw_anchors: ", name, " must be contiguous float32 ", shape, " on the CPU, got ", t.toString(), " ",
              t.sizes());
  return t.const_data_ptr<float>();
}

}  // namespace sw_anchors
