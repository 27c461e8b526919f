// For binding files only: a `Parallel` on torch's intra-op thread pool.
#pragma once
#include <ATen/Parallel.h>
#include <splatwizard/parallel.h>

namespace splatwizard {

inline Parallel torch_parallel() {
  auto run = [](int32_t, int64_t count, int64_t grain, Parallel::Body body, void* state) {
    at::parallel_for(0, count, grain, [&](int64_t begin, int64_t end) { body(state, begin, end); });
  };
  return {run, at::get_num_threads()};
}

}  // namespace splatwizard
