// The bits of a sample of anchors under predicted Gaussians, and their derivatives.
#pragma once

#include <cstdint>

namespace sw_anchors {

// A sample of S anchors: numbers, means and deviations [S,F+6+3k], steps [S,3], [S] 1 where an anchor counts, masks [S,k].
struct Sample {
  int64_t count;
  int features, offsets;
  const float *x, *mean, *scale, *steps, *counted, *masks;
  float smallest;        // probability
  float smallest_scale;  // floor of the deviations
};

// Bits [S,3] by group, and derivatives of their sum.
struct SampleBits {
  float *bits, *x, *mean, *scale, *steps, *masks;
};

}  // namespace sw_anchors
