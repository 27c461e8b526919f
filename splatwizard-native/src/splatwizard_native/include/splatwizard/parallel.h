// How a kernel runs in parallel without knowing who lends the threads: it is handed a `Parallel`.
//
//   void scale(float* x, int64_t n, const splatwizard::Parallel& parallel) {
//     parallel(n, 4096, [&](int64_t begin, int64_t end) { for (int64_t i = begin; i < end; ++i) x[i] *= 2; });
//   }
//
// The threads are those of splatwizard_native/pool, as many as torch.get_num_threads() says. How a range is cut depends on their number, so a kernel whose result must not
// depend on it computes every element in one order whatever the cut, or reduces per fixed block.
#pragma once
#include <atomic>
#include <cstdint>
#include <exception>
#include <type_traits>

namespace splatwizard {

struct Parallel {
  using Body = void (*)(void* state, int64_t begin, int64_t end);
  // Calls body(state, begin, end) on disjoint ranges that cover [0, count), each at least `grain` long but the last.
  // Null: all of it is done here.
  void (*run)(int32_t threads, int64_t count, int64_t grain, Body body, void* state);
  int threads;

  // The first exception of a body is thrown again here: none passes through whoever lends the threads.
  template <class F>
  void operator()(int64_t count, int64_t grain, F&& body) const {
    if (count <= 0) return;
    if (run == nullptr || threads < 2) return body(int64_t{0}, count);
    struct State {
      std::remove_reference_t<F>* body;
      std::atomic<bool> failed{false};
      std::exception_ptr error;
    } state{&body, {}, {}};
    auto call = [](void* at, int64_t begin, int64_t end) {
      State& told = *static_cast<State*>(at);
      try {
        (*told.body)(begin, end);
      } catch (...) {
        if (!told.failed.exchange(true)) told.error = std::current_exception();
      }
    };
    run(threads, count, grain, call, &state);
    if (state.failed) std::rethrow_exception(state.error);
  }
};

}  // namespace splatwizard
