// The three networks of anchors and the Gaussians that they spawn, in one pass over blocks of anchors; on the CPU.
//
// Of the networks that give shapes and colours only the outputs of Gaussians that are drawn are computed: those of
// opacity > 0. Hidden layers stand side by side in rows of `width` floats, each padded to whole vectors.
#pragma once

#include <cstdint>

#include "spawn.h"

namespace sw_anchors {

constexpr int kHeads = 3;                              // opacity, geometry, colour
constexpr int kOutputs[kHeads] = {1, kGeometry, 3};    // of a Gaussian

struct Heads {
  int64_t features, hidden;              // inputs besides direction and distance; width of a hidden layer
  const float* first[kHeads];            // [hidden, features + 4]
  const float* first_bias[kHeads];       // [hidden]
  const float* last[kHeads];             // [kOutputs k, hidden]
  const float* last_bias[kHeads];        // [kOutputs k]
};

struct HeadGradients {  // of the members of Heads, without gaps
  float *first[kHeads], *first_bias[kHeads], *last[kHeads], *last_bias[kHeads];
};

// Where anchors are seen from: center [3], features [n, features] in rows `feature_row` apart.
struct Seen {
  const float *center, *features;
  int64_t feature_row;
};

}  // namespace sw_anchors
