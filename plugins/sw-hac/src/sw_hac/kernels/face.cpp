#include "calls.h"
#include "kernels.h"

using namespace sw_hac;
using splatwizard::refuse;

SW_OPERATION(sw_hac, mixture_bits) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const Mixture from = mixture_of(*call);
    for (int64_t i = 0; from.columns != nullptr && i < 3 * from.features; ++i)
      if (from.columns[i] < 0 || from.columns[i] >= 3 * from.features)
        refuse("column %d of a second Gaussian of %d numbers", int(from.columns[i]), 3 * from.features);
    SW_SELECT(mixture_bits)(from, slopes_of(*call), parallel);
  });
}

SW_OPERATION(sw_hac, channel_inputs) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    SW_SELECT(channel_inputs)(channels_of(*call, call->inputs), call->x, call->outputs, call->inputs, parallel);
  });
}

SW_OPERATION(sw_hac, channel_slopes) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    SW_SELECT(channel_slopes)(channels_of(*call, call->by_inputs),
                              {call->slope, call->by_x, call->by_outputs, call->by_inputs}, call->to_x,
                              call->to_outputs, parallel);
  });
}
