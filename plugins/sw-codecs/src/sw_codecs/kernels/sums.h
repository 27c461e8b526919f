// Memory of sums that are the same in any order (cuda/sums.h).
#pragma once

#include <ATen/core/Tensor.h>
#include <ATen/ops/zeros.h>

#include "cuda/sums.h"

namespace sw_sums {

// A number on the device that no addend exceeds.
inline const float* checked_largest(const at::Tensor& largest, const at::Tensor& like) {
  TORCH_CHECK(largest.numel() == 1 && largest.scalar_type() == at::kFloat && largest.device() == like.device(),
              "sw_codecs: the largest number must be one float32 on ", like.device(), ", got ", largest.toString(), " ",
              largest.sizes());
  return largest.const_data_ptr<float>();
}

// Zeros for the sums of a table, of at most `count` numbers each.
struct Held {
  at::Tensor memory;
  Sums sums;

  Held(const at::Tensor& largest, const at::Tensor& table, int64_t count)
      : memory(at::zeros(table.sizes(), table.options().dtype(at::kLong).requires_grad(false))),
        sums{reinterpret_cast<Whole*>(memory.mutable_data_ptr<int64_t>()), checked_largest(largest, table), count} {}
};

}  // namespace sw_sums
