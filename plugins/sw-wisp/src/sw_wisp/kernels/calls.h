// From the structs of face.h to those of kernels.h, with the checks that both modules make.
#pragma once

#include "face.h"
#include "kernels.h"

namespace sw_wisp {

template <class Call>
Plan plan_of(const Call& call, bool moves_steps) {
  const int32_t phase = call.phase;
  if (phase < kAsTheyAre || phase > kHard) splatwizard::refuse("there is no phase %d", int(phase));
  if ((phase == kNoise || phase == kSoft) && call.noise == nullptr) splatwizard::refuse("phase %d needs noise", int(phase));
  const double half = phase == kSoft ? 0.5 / std::tanh(0.5 * call.sharpness) : 0.;
  return {phase, float(call.sharpness), float(half), call.soft, call.adaptive, moves_steps};
}

inline Matrices of_call(const eight_bits_call& call) {
  if (call.count < 0 || call.count > 16) splatwizard::refuse("%d matrices are more than 16", int(call.count));
  if (call.lowest > kHighestExponent || call.lowest < -60) splatwizard::refuse("no exponent %d", int(call.lowest));
  Matrices found{};
  found.count = call.count, found.lowest = call.lowest;
  for (int i = 0; i < call.count; ++i)
    found.each[i] = {call.weights[i], call.rounded[i], call.rows[i], call.columns[i]};
  return found;
}

inline Draw of_call(const draw_call& call) {
  if (call.block < 0 || call.block >= kBlocks) splatwizard::refuse("there is no block %d", int(call.block));
  Draw found{};
  found.block = call.block, found.plan = plan_of(call, true);
  found.rows = call.rows, found.values = call.values, found.noise = call.noise, found.outputs = call.outputs;
  found.inputs = call.inputs, found.view_inputs = call.view_inputs;
  found.base_steps = call.base_steps, found.multipliers = call.multipliers;
  for (int i = 0; i < kTies; ++i) found.ties[i] = call.ties[i];
  found.mean = call.mean, found.scale = call.scale, found.steps = call.steps, found.drawn = call.drawn;
  found.told = call.told;
  return found;
}

inline DrawBack of_call(const draw_backward_call& call) {
  return {plan_of(call, call.moves_steps),
          call.rows,    call.values,   call.noise,    call.mean,     call.steps,      call.outputs, call.base_steps,
          call.by_mean, call.by_scale, call.by_steps, call.by_drawn, call.to_outputs, call.to_values};
}

template <class Call>
void check_last(const Call& call) {
  if (call.last < 0 || call.last > call.rows)
    splatwizard::refuse("%lld of %lld rows cannot be counted", (long long)call.last, (long long)call.rows);
}

inline CountedRows of_call(const bits_call& call) {
  check_last(call);
  return {call.values, call.mean, call.scale, call.steps, call.rows, call.last, call.bits,
          nullptr,     nullptr,   nullptr,    nullptr,    nullptr};
}

inline CountedRows of_call(const bits_backward_call& call) {
  check_last(call);
  return {call.values,  call.mean,      call.scale,   call.steps,    call.rows,    call.last, nullptr,
          call.by_bits, call.to_values, call.to_mean, call.to_scale, call.to_steps};
}

inline Splats of_call(const splats_call& call) {
  return {call.values,      call.log_edges, float(call.low), float(call.high), call.rows,
          call.covariances, call.opacities, call.dc,         call.axes};
}

inline SplatsBack of_call(const splats_backward_call& call) {
  return {float(call.low),     float(call.high),  call.rows,  call.axes,      call.opacities,
          call.by_covariances, call.by_opacities, call.by_dc, call.by_colour, call.to_values};
}

}  // namespace sw_wisp
