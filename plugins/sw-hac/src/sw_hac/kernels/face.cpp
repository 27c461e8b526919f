#include "face.h"

#include "kernels.h"

using namespace sw_hac;
using splatwizard::refuse;

namespace {

template <class Call>
Channels channels_of(const Call& call) {
  if (call.features < 1 || call.features > call.numbers || 3 * call.features > call.width)
    refuse("%lld features do not fit %lld numbers and %lld outputs", (long long)call.features, (long long)call.numbers,
           (long long)call.width);
  const int64_t taken = call.features * (call.context ? 4 : 1);
  return {call.count, int(call.features), int(call.numbers), int(call.width), int(taken / 4 * 4 + 4),
          call.units, float(call.base),   call.context};
}

}  // namespace

SW_OPERATION(sw_hac, mixture_bits) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const int64_t numbers = call->numbers, k = call->k, features = numbers - 6 - 3 * k;
    const bool mixed = call->columns != nullptr;
    if (features < 0) refuse("%lld numbers are too few for %lld offsets", (long long)numbers, (long long)k);
    if (call->width < 2 * numbers + (mixed ? features : 0))
      refuse("%lld outputs are too few for %lld numbers", (long long)call->width, (long long)numbers);
    if (call->count > 0 && (mixed != (call->second != nullptr) || mixed != (call->to_second != nullptr)))
      refuse("a second Gaussian needs its columns and a gradient");
    if (mixed && call->features != features)
      refuse("a second Gaussian of %lld features of %lld", (long long)call->features, (long long)features);
    if (call->kind < kAlone || call->kind > kGatedMean) refuse("there is no kind %d of masks", int(call->kind));
    for (int64_t i = 0; mixed && i < 3 * features; ++i)
      if (call->columns[i] < 0 || call->columns[i] >= 3 * features)
        refuse("column %d of a second Gaussian of %lld numbers", int(call->columns[i]), (long long)(3 * features));
    Mixture from{};
    from.count = call->count, from.features = int(features), from.offsets = int(k), from.width = int(call->width);
    from.x = call->x, from.outputs = call->outputs, from.units = call->units;
    from.second = call->second, from.columns = call->columns;
    from.steps = call->steps, from.masks = call->masks, from.counted = call->counted;
    from.base = float(call->base), from.kind = MaskKind(call->kind);
    from.bounds = {float(call->smallest), float(call->smallest_scale), float(call->scale_floor)};
    SW_SELECT(mixture_bits)(from, {call->bits, call->to_x, call->to_outputs, call->to_steps, call->to_masks,
                                   call->to_second}, parallel);
  });
}

SW_OPERATION(sw_hac, channel_inputs) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const Channels of = channels_of(*call);
    if (call->columns != of.inputs) refuse("there are %d inputs, not %lld", of.inputs, (long long)call->columns);
    SW_SELECT(channel_inputs)(of, call->x, call->outputs, call->inputs, parallel);
  });
}

SW_OPERATION(sw_hac, channel_slopes) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const Channels of = channels_of(*call);
    if (call->by_inputs != nullptr && call->columns != of.inputs)
      refuse("there are %d inputs, not %lld", of.inputs, (long long)call->columns);
    const float slope = float(call->slope);
    SW_SELECT(channel_slopes)(of, {&slope, call->by_x, call->by_outputs, call->by_inputs}, call->to_x,
                              call->to_outputs, parallel);
  });
}
