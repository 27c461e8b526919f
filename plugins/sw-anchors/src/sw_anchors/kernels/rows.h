// Rows of anchors in a training step, on CUDA: what is copied, and the noisy numbers.
#pragma once

#include <cstdint>

#include "sample.h"

namespace sw_anchors {

constexpr int kTensors = 12;  // whose rows are copied together
constexpr int kGroups = 3;    // features, scales, offsets

// Tensors whose rows are copied. Words (4 bytes) of a row are numbered through all of them: those of tensor i end before
// `last[i]`. Rows are `from_row` and `to_row` words apart.
struct RowCopies {
  int words;
  int last[kTensors];
  const uint32_t* from[kTensors];
  uint32_t* to[kTensors];
  int64_t from_row[kTensors], to_row[kTensors];
};

// Of C anchors with F features, k offsets: numbers are F features, 6 scales, 3 k coordinates of offsets.
struct Rows {
  int64_t count;
  int features, offsets;       // F, k
  const float* feature_rows;   // [C,F]
  const float* log_scales;     // [C,6]
  const float* offset_rows;    // [C,3k]
  const float* logits;         // [C,k] of masks
  const float* weights;        // [C] of masks, or null for 1
  const float* valid;          // scalar: rows from here on have masks 0; or null
  const float* noise;          // [C,F+6+3k] in -1/2 .. 1/2, or null
  const float* steps;          // rows of 3, `step_row` apart (0: one for all), or null
  int64_t step_row;
  float threshold;             // of sigmoid(logit) times weight
};

// Gradients by all numbers [C,F+6+3k], and by those of each group again; each may be null. Rows are `row` apart.
struct Piece {
  const float* at;
  int64_t row;
};
struct RowSlopes {
  Piece all, group[kGroups];
  Piece masks;
};

struct RowGradients {
  float *features, *log_scales, *offsets, *logits;
  float* steps;  // [C,3] or null
};

}  // namespace sw_anchors
