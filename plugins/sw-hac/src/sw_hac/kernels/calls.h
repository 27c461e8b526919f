// The calls of face.h as the kernels take them, checked as far as the host can read.
#pragma once
#include "face.h"
#include "mixture.h"

namespace sw_hac {

inline Mixture mixture_of(const mixture_bits_call& call) {
  using splatwizard::refuse;
  const int64_t numbers = call.numbers, k = call.k, features = numbers - 6 - 3 * k;
  const bool mixed = call.columns != nullptr;
  if (features < 0) refuse("%lld numbers are too few for %lld offsets", (long long)numbers, (long long)k);
  if (call.width < 2 * numbers + (mixed ? features : 0))
    refuse("%lld outputs are too few for %lld numbers", (long long)call.width, (long long)numbers);
  if (call.count > 0 && (mixed != (call.second != nullptr) || mixed != (call.to_second != nullptr)))
    refuse("a second Gaussian needs its columns and a gradient");
  if (mixed && call.features != features)
    refuse("a second Gaussian of %lld features of %lld", (long long)call.features, (long long)features);
  if (call.kind < kAlone || call.kind > kGatedMean) refuse("there is no kind %d of masks", int(call.kind));
  Mixture from{};
  from.count = call.count, from.features = int(features), from.offsets = int(k), from.width = int(call.width);
  from.x = call.x, from.outputs = call.outputs, from.units = call.units;
  from.second = call.second, from.columns = call.columns;
  from.steps = call.steps, from.masks = call.masks, from.counted = call.counted;
  from.base = float(call.base), from.kind = MaskKind(call.kind);
  from.bounds = {float(call.smallest), float(call.smallest_scale), float(call.scale_floor)};
  return from;
}

inline MixtureSlopes slopes_of(const mixture_bits_call& call) {
  return {call.bits, call.to_x, call.to_outputs, call.to_steps, call.to_masks, call.to_second};
}

// `inputs`: the tensor with `columns` columns, if there is one.
template <class Call>
Channels channels_of(const Call& call, const float* inputs) {
  using splatwizard::refuse;
  if (call.features < 1 || call.features > call.numbers || 3 * call.features > call.width)
    refuse("%lld features do not fit %lld numbers and %lld outputs", (long long)call.features, (long long)call.numbers,
           (long long)call.width);
  const int64_t taken = call.features * (call.context ? 4 : 1), all = taken / 4 * 4 + 4;
  if (inputs != nullptr && call.columns != all)
    refuse("there are %lld inputs, not %lld", (long long)all, (long long)call.columns);
  return {call.count, int(call.features), int(call.numbers), int(call.width), int(all),
          call.units, float(call.base),   call.context};
}

}  // namespace sw_hac
