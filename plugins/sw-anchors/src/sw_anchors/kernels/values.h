// Noisy values of anchors in training: features, scales and offsets of some rows, with their masks.
#pragma once

#include <cstdint>

namespace sw_anchors {

constexpr int kGroups = 3;  // features, scales, offsets: each has a quantiser step of its own

struct Rows {
  int64_t count, features, k;  // rows taken; widths
  const int64_t* rows;         // [count], each at most once
  const float *of_features, *log_scales, *of_offsets, *mask_logits;  // [N, features], [N,6], [N,3k], [N,k]
  const float* mask_weights;   // [N] or null
  float threshold;
  const float* steps;          // [count,3] or [3], or null: no noise
  int64_t step_row;            // 3 or 0
  const float* uniform;        // [count, features + 6 + 3k] draws of U(0,1), or null
  const int64_t* drawn;        // [samples] ascending places in `rows`
  int64_t samples;
};

// Results, or gradients by them: [count, ...], sample [samples, features + 6 + 3k].
struct RowValues {
  float *features, *scales, *offsets, *masks, *sample;
};

struct RowGradients {  // of the tables, zeros before; and of the steps [count,3] or null
  float *features, *log_scales, *offsets, *mask_logits, *steps;
};

}  // namespace sw_anchors
