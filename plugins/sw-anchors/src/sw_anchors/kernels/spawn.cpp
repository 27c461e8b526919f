// Gaussians that anchors spawn, and the gradient, on the CPU.
#include <algorithm>

#include "kernels.h"

namespace SW_ARCH {

using namespace sw_anchors;

void spawn(const Anchors& from, const Gaussians& to, const splatwizard::Parallel& parallel) {
  parallel(from.count, 512, [&](int64_t begin, int64_t end) {
    for (int64_t m = begin; m < end; ++m) spawn_one(from, m, to);
  });
}

void spawn_backward(const Anchors& from, const Gaussians& slope, const Gradients& to,
                    const splatwizard::Parallel& parallel) {
  const auto first_of = [&](int64_t anchor) {
    return std::lower_bound(from.drawn, from.drawn + from.count, anchor * from.k) - from.drawn;
  };
  const auto add = [](float* place, float value) { *place += value; };
  parallel(from.n, 128, [&](int64_t begin, int64_t end) {
    const int64_t last = first_of(end);
    for (int64_t m = first_of(begin); m < last; ++m) spawn_one_backward(from, m, slope, to, add);
  });
}

}  // namespace SW_ARCH
