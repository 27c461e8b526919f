// What adam_many is handed, checked.
#pragma once

#include <ATen/core/Tensor.h>
#include <c10/util/ArrayRef.h>
#include <c10/util/Exception.h>

#include <cstddef>
#include <cstdint>
#include <initializer_list>
#include <vector>

namespace splatwizard {

// How many parameters there are: a tensor of each kind and a number of each kind for every one.
inline size_t adam_count(const std::vector<at::Tensor>& params,
                         std::initializer_list<const std::vector<at::Tensor>*> tensors,
                         std::initializer_list<at::ArrayRef<double>> numbers, at::IntArrayRef steps) {
  bool alike = steps.size() == params.size();
  for (const std::vector<at::Tensor>* list : tensors) alike = alike && list->size() == params.size();
  for (const at::ArrayRef<double>& list : numbers) alike = alike && list.size() == params.size();
  TORCH_CHECK(alike, "adam: lists of different lengths");
  return params.size();
}

// Whether the kernel of a device can do this step: it is counted from 1, and all tensors, the parameter first, are
// float32, contiguous, of its shape, on the device, and start at a multiple of `alignment` bytes.
inline bool fits_adam(at::Device device, size_t alignment, int64_t step,
                      std::initializer_list<const at::Tensor*> tensors) {
  const at::Tensor& param = **tensors.begin();
  for (const at::Tensor* tensor : tensors)
    if (tensor->device() != device || tensor->scalar_type() != at::kFloat || !tensor->is_contiguous() ||
        tensor->sizes() != param.sizes() || reinterpret_cast<uintptr_t>(tensor->const_data_ptr()) % alignment != 0)
      return false;
  return step >= 1;
}

// Count up the versions, as every change in place does: the kernels write behind autograd's back.
inline void count_versions(const std::vector<at::Tensor>& params) {
  for (const at::Tensor& param : params)
    if (!param.is_inference()) param.unsafeGetTensorImpl()->bump_version();
}

}  // namespace splatwizard
