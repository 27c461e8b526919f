// In place of splatwizard-native's header of this name: the module has one thread, and no exceptions to carry.
#pragma once
#include <cstdint>

namespace splatwizard {

struct Parallel {
  static constexpr int64_t threads = 1;

  template <class F>
  void operator()(int64_t count, int64_t, F&& body) const {
    if (count > 0) body(int64_t{0}, count);
  }
};

}  // namespace splatwizard
