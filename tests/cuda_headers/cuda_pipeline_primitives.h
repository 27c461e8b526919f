// Copies arrive only where their thread waits for them.
#pragma once
#include <cuda_runtime_api.h>

namespace cuda_on_cpu {

struct Copy {
  void* to;
  const void* from;
  size_t bytes;
  int64_t group;
};
struct Pipeline {
  std::vector<Copy> copies;
  int64_t groups = 0;
};
inline std::map<const Fiber*, Pipeline> pipelines;

}  // namespace cuda_on_cpu

inline void __pipeline_memcpy_async(void* to, const void* from, size_t bytes) {
  auto& own = cuda_on_cpu::pipelines[cuda_on_cpu::state.current];
  own.copies.push_back({to, from, bytes, own.groups});
}
inline void __pipeline_commit() { ++cuda_on_cpu::pipelines[cuda_on_cpu::state.current].groups; }
inline void __pipeline_wait_prior(size_t later) {
  auto& own = cuda_on_cpu::pipelines[cuda_on_cpu::state.current];
  std::erase_if(own.copies, [&](const cuda_on_cpu::Copy& copy) {
    if (copy.group >= own.groups - int64_t(later)) return false;
    return std::memcpy(copy.to, copy.from, copy.bytes), true;
  });
}
