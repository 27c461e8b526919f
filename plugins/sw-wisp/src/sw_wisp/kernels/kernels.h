// What the kernels of the CPU and of the GPU are given.
#pragma once

#include "rows.h"

namespace sw_wisp {

struct Matrix {
  const float* weights;
  float* rounded;
  int64_t rows, columns;
};

struct Matrices {
  Matrix each[16];
  int count, lowest;
};

// Bits of the last rows, or gradients of all: by_bits is null or to_values is.
struct CountedRows {
  const float *values, *mean, *scale, *steps;
  int64_t rows, last;
  float* bits;
  const float* by_bits;
  float *to_values, *to_mean, *to_scale, *to_steps;
};

struct Splats {
  const float *values, *log_edges;
  float low, high;
  int64_t rows;
  float *covariances, *opacities, *dc, *axes;
};

struct SplatsBack {
  float low, high;
  int64_t rows;
  const float *axes, *opacities, *by_covariances, *by_opacities, *by_dc, *by_colour;
  float* to_values;
};

}  // namespace sw_wisp
