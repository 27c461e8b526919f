// Colours from a codebook; the work is done in shared_colors.cpp.
#include <algorithm>

#include "shared_colors.h"
#include "face.h"
#include "../face_shared_inputs.h"

namespace {

using namespace sw;  // NOLINT: one file

template <class S>
void backward(const shade_shared_backward_call& call, const Parallel& parallel) {
  const auto shared = shared_of<S>(call, &parallel);
  S* const passed = numbers<S>(call.passed);
  S* const codebook = numbers<S>(call.of_codebook);
  if (call.count == 0) {
    std::fill_n(codebook, call.entries * shared.stride, S(0));
    return;
  }
  SW_SELECT(shade_shared_backward<S>)(shared, numbers<S>(call.by_colors), passed, numbers<S>(call.of_means),
                                      numbers<S>(call.of_dc));
  SW_SELECT(add_to_codebook<S>)(shared, call.order, call.offsets, passed, codebook);
}

}  // namespace

SW_OPERATION(sw_rasterizers, shade_shared) {
  return with_numbers(call, [&](auto number, const Parallel& parallel) {
    using S = decltype(number);
    const auto shared = shared_of<S>(*call, &parallel);
    if (call->count > 0) SW_SELECT(shade_shared<S>)(shared, numbers<S>(call->colors));
  });
}

SW_OPERATION(sw_rasterizers, shade_shared_backward) {
  return with_numbers(call, [&](auto number, const Parallel& parallel) { backward<decltype(number)>(*call, parallel); });
}
