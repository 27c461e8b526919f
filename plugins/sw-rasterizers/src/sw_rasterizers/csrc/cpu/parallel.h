// Threads. Work is split so that no result depends on who did it: see the callers.
#pragma once

#include <atomic>
#include <cstdint>

#include <splatwizard/parallel.h>

namespace SW_ARCH {

inline int count_of(const splatwizard::Parallel* threads) { return threads == nullptr ? 1 : threads->threads; }

// body() on each of the threads, or on some of them, maybe again: it takes work until none is left, and waits for nobody.
template <class Body>
inline void parallel(const splatwizard::Parallel* threads, const Body& body) {
  if (threads == nullptr) return body();
  (*threads)(threads->threads, 1, [&](int64_t, int64_t) { body(); });
}

// body(i) for 0 <= i < n; threads take the next i when they are free.
template <class Body>
inline void parallel_dynamic(const splatwizard::Parallel* threads, int64_t n, const Body& body) {
  std::atomic<int64_t> next{0};
  parallel(n > 1 ? threads : nullptr, [&] {
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < n;) body(i);
  });
}

}  // namespace SW_ARCH
