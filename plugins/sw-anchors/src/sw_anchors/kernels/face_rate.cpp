// Noisy values of anchors, their quantiser steps and bits.
#include "calls.h"
#include "kernels.h"

using namespace sw_anchors;
using splatwizard::refuse;

namespace {

// Ascending, if so asked; each within 0 .. limit - 1.
void check_places(const int64_t* places, int64_t count, const char* name, int64_t limit, bool ascending) {
  bool wrong = false;  // without branches, in vectors
  for (int64_t i = 0; i < count; ++i) wrong |= places[i] < 0 || places[i] >= limit;
  for (int64_t i = 1; ascending && i < count; ++i) wrong |= places[i] <= places[i - 1];
  for (int64_t i = 0; wrong; ++i)
    if (places[i] < 0 || places[i] >= limit || (ascending && i > 0 && places[i] <= places[i - 1]))
      refuse("%s[%lld] is %lld of %lld", name, (long long)i, (long long)places[i], (long long)limit);
}

template <class Call>
Rows rows_of(const Call& call) {
  check_places(call.rows, call.count, "rows", call.total, false);
  check_places(call.drawn, call.samples, "drawn", call.count, true);
  if (call.count > 0 && (call.steps == nullptr) != (call.uniform == nullptr)) refuse("noise has steps and draws");
  if (call.steps != nullptr && call.step_rows != 1 && call.step_rows != call.count)
    refuse("%lld steps for %lld rows", (long long)call.step_rows, (long long)call.count);
  Rows from{};
  from.count = call.count, from.features = call.width, from.k = call.k, from.rows = call.rows;
  from.of_features = call.features, from.log_scales = call.log_scales;
  from.of_offsets = call.offsets, from.mask_logits = call.mask_logits, from.mask_weights = call.mask_weights;
  from.threshold = float(call.threshold), from.steps = call.steps, from.uniform = call.uniform;
  from.step_row = call.step_rows == 1 ? 0 : kGroups;
  from.drawn = call.drawn, from.samples = call.samples;
  return from;
}

template <class Call>
StepNetwork network_of(const Call& call) {
  if (call.inputs < 1 || call.units < 1)
    refuse("a network of %lld inputs and %lld units", (long long)call.inputs, (long long)call.units);
  return {call.count, call.inputs,    call.units, call.features,       call.first,          call.first_bias,
          call.last,  call.last_bias, call.base,  float(call.offset), float(call.smallest)};
}

}  // namespace

SW_OPERATION(sw_anchors, noisy_values) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    SW_SELECT(noisy_values)(rows_of(*call), {call->to_features, call->to_scales, call->to_offsets, call->to_masks,
                                             call->to_sample}, parallel);
  });
}

SW_OPERATION(sw_anchors, noisy_values_backward) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const auto read_only = [](const float* p) { return const_cast<float*>(p); };
    const RowValues by{read_only(call->by_features), read_only(call->by_scales), read_only(call->by_offsets),
                       read_only(call->by_masks), read_only(call->by_sample)};
    if (call->to_steps != nullptr && call->steps == nullptr) refuse("there are no steps to have a gradient");
    SW_SELECT(noisy_values_backward)(rows_of(*call), by, {call->to_features, call->to_log_scales, call->to_offsets,
                                                          call->to_mask_logits, call->to_steps}, parallel);
  });
}

SW_OPERATION(sw_anchors, predicted_steps) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    SW_SELECT(predicted_steps)(network_of(*call), call->hidden, call->tangents, call->steps, parallel);
  });
}

SW_OPERATION(sw_anchors, predicted_steps_backward) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    const StepGradients to{call->to_features, call->to_first, call->to_first_bias, call->to_last, call->to_last_bias};
    SW_SELECT(predicted_steps_backward)(network_of(*call), call->hidden, call->tangents, call->by_steps,
                                        call->by_hidden, to, parallel);
  });
}

SW_OPERATION(sw_anchors, sample_bits) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    SW_SELECT(sample_bits)(sample_of(*call), bits_of(*call), parallel);
  });
}
