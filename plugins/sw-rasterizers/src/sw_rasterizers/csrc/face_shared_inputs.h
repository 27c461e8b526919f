// The calls of shared colours as the kernels take them.
#pragma once

#include "face_inputs.h"
#include "shared_colors.h"

namespace sw {

// `parallel` null: on a GPU.
template <class S, class Call>
SharedColors<S> shared_of(const Call& call, const Parallel* parallel) {
  constexpr int64_t most = std::numeric_limits<int32_t>::max();
  const int first = call.dc != nullptr;
  const int64_t basis = (call.degree + 1) * (call.degree + 1);
  if (call.degree < 0 || call.degree > 3 || (call.count > 0 && call.coefficients + first < basis))
    refuse("SH degree %d needs %lld coefficients, got %lld", int(call.degree), (long long)basis,
           (long long)(call.coefficients + first));
  if (call.count < 0 || call.count >= most || call.entries < 0 || call.entries >= most)
    refuse("%lld Gaussians, %lld entries: at most 2^31 - 2", (long long)call.count, (long long)call.entries);
  return {call.count, call.entries, numbers<S>(call.means), numbers<S>(call.dc), numbers<S>(call.codebook),
          3 * call.coefficients, first, call.rows, numbers<S>(call.center), int(call.degree), call.clamp != 0,
          parallel};
}

}  // namespace sw
