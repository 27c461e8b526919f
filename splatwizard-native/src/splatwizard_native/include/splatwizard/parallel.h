// How a kernel runs in parallel without including a torch header: the binding file hands it a `Parallel`.
//
//   void scale(float* x, int64_t n, const splatwizard::Parallel& parallel) {
//     parallel(n, 4096, [&](int64_t begin, int64_t end) { for (int64_t i = begin; i < end; ++i) x[i] *= 2; });
//   }
//
// The binding file gets one from <splatwizard/torch_parallel.h>: it runs on torch's own thread pool and obeys
// torch.set_num_threads. How a range is cut depends on the number of threads, so a kernel whose result must not
// depend on it computes every element in one order whatever the cut, or reduces per fixed block.
#pragma once
#include <cstdint>
#include <type_traits>

namespace splatwizard {

struct Parallel {
  using Body = void (*)(void* state, int64_t begin, int64_t end);
  // Calls body(state, begin, end) on disjoint ranges that cover [0, count), each at least `grain` long but the last.
  void (*run)(int64_t count, int64_t grain, Body body, void* state);
  int threads;

  template <class F>
  void operator()(int64_t count, int64_t grain, F&& body) const {
    using Plain = std::remove_reference_t<F>;
    auto call = [](void* state, int64_t begin, int64_t end) { (*static_cast<Plain*>(state))(begin, end); };
    run(count, grain, call, const_cast<void*>(static_cast<const void*>(&body)));
  }
};

}  // namespace splatwizard
