// The network that predicts quantiser steps of anchors: one hidden layer, three outputs.
#pragma once

#include <cstdint>

namespace sw_anchors {

struct StepNetwork {
  int64_t count, inputs, hidden;
  const float* features;                     // [count, inputs]
  const float *first, *first_bias;           // [hidden, inputs], [hidden]
  const float *last, *last_bias;             // [3, hidden], [3]
  const float* base;                         // [3]; a step is its base times max(offset + tanh(output), smallest)
  float offset, smallest;
};

struct StepGradients {  // of the members of StepNetwork
  float *features, *first, *first_bias, *last, *last_bias;
};

}  // namespace sw_anchors
