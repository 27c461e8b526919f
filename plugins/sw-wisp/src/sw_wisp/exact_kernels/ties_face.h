// All operations of the module: running means, what the parts of a block say of those behind them (sw_wisp.ties), what
// a walk through packets does with forecasts (sw_wisp.packets), and axes of decoded splats (sw_wisp.shape).
#pragma once
#include "face.h"

// Additions to means and scale levels of a part of a block, for numbers of the block that are known.
typedef struct {
  sw_head head;
  const int32_t* index;       // [splats, 22] steps from the means
  const int32_t* scale;       // [splats, 22] levels with 12 fractional bits
  const int32_t* multiplier;  // [splats, 22]
  int64_t splats;
  int64_t first, step;        // rows: first, first + step, ...
  int64_t start;              // column of the first known number
  const int64_t* weights;     // [2, columns, before] of residuals, then of sizes, in 1/4096
  const int64_t* sizes;       // [64] of a step under each table, 12 fractional bits
  int64_t n, columns, before;
  int64_t* moved;             // [2, n, columns] of means, then of scale levels
} moved_call;
SW_OPERATION(sw_wisp_exact, moved);

// Distributions of the numbers of a block, from running means and the outputs of its network.
typedef struct {
  sw_head head;
  const int64_t* features;     // [n, seen]
  int64_t start;               // column of the features that the means of the block begin at
  const int64_t* outputs;      // [n, given] additions to the means, scale levels, step outputs
  const int64_t* multipliers;  // [128] or null: of step outputs, else 4096 for all
  const int64_t* step_of;      // [columns] which step output each column has
  int64_t n, seen, given, columns;
  int64_t* mean;               // [n, columns]
  int64_t* scale;              // [n, columns]
  int64_t* multiplier;         // [n, columns]
} forecasts_call;
SW_OPERATION(sw_wisp_exact, forecasts);

// Keeps what predicts a part of a block, within its limits, and tells the tables that code it.
typedef struct {
  sw_head head;
  const int64_t* mean;        // [n, width] of a block
  const int64_t* scale;       // [n, width]
  const int64_t* multiplier;  // [n, width]
  int64_t begin;              // column of the block that the part begins at
  const int64_t* moved;       // [2, n, columns] or null: additions to means, then to scale levels
  int64_t first, step;        // rows of splats: first, first + step, ...
  int64_t start;              // column of splats that the part begins at
  int64_t lower;              // scale levels by which coarse indices have a lower table
  int64_t n, width, columns, splats;
  int32_t* to_mean;           // [splats, 22]
  int32_t* to_scale;          // [splats, 22]
  int32_t* to_multiplier;     // [splats, 22]
  uint8_t* tables;            // [n, columns]
} kept_call;
SW_OPERATION(sw_wisp_exact, kept);

// Values of splats: mean + index * multiplier.
typedef struct {
  sw_head head;
  const int32_t* mean;        // [splats, 22]
  const int32_t* index;       // [splats, 22]
  const int32_t* multiplier;  // [splats, 22]
  int64_t splats;
  int64_t first, step;        // rows: first, first + step, ...
  int64_t start;              // first column
  int64_t n, columns;
  int64_t* found;             // [n, columns]
} values_call;
SW_OPERATION(sw_wisp_exact, values);

// Axes of splats, of the logarithms of the roots of their covariances.
typedef struct {
  sw_head head;
  const double* six;          // [n, 6] xx, xy, xz, yy, yz, zz of each matrix
  int64_t n;
  double* log_scales;         // [n, 3] ascending
  double* quats;              // [n, 4] w, x, y, z of norm 1, w >= 0
} axes_call;
SW_OPERATION(sw_wisp_exact, axes);
