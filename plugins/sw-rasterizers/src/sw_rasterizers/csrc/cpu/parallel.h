// Threads. Work is split so that no result depends on who did it: see the callers.
#pragma once

#include <atomic>
#include <cstdint>

#if defined(_OPENMP)
#include <omp.h>
#endif

namespace SW_ARCH {

// body(thread, threads) on each of at most `threads` threads.
template <class Body>
inline void parallel(int threads, const Body& body) {
#if defined(_OPENMP)
  if (threads > 1) {
#pragma omp parallel num_threads(threads)
    body(omp_get_thread_num(), omp_get_num_threads());
    return;
  }
#endif
  body(0, 1);
}

// body(i) for 0 <= i < n; threads take the next i when they are free.
template <class Body>
inline void parallel_dynamic(int threads, int64_t n, const Body& body) {
  std::atomic<int64_t> next{0};
  parallel(n > 1 ? threads : 1, [&](int, int) {
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < n;) body(i);
  });
}

}  // namespace SW_ARCH
