// What the CPU bindings share: memory for tensors, and a stop watch for the stages.
#pragma once

#include <ATen/core/Tensor.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/from_blob.h>

#include <chrono>

#include "cpu/recycler.h"

namespace sw {

using at::Tensor;

// An uninitialised tensor; large ones come from the recycler.
inline Tensor make_tensor(at::IntArrayRef shape, const at::TensorOptions& options) {
  size_t bytes = c10::elementSize(options.dtype().toScalarType());
  for (const int64_t size : shape) bytes *= size_t(size);
  if (bytes < Recycler::kSmallest) return at::empty(shape, options);
  return at::from_blob(
      Recycler::instance().take(bytes), shape, [](void* pointer) { Recycler::instance().give(pointer); },
      options);
}

struct Clock {
  std::chrono::steady_clock::time_point since = std::chrono::steady_clock::now();
  double lap() {
    const auto now = std::chrono::steady_clock::now();
    const double seconds = std::chrono::duration<double>(now - since).count();
    since = now;
    return seconds;
  }
};

}  // namespace sw
