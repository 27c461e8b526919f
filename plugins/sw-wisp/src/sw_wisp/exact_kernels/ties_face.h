// All operations of the module: running means, and what the parts of a block say of those behind them (sw_wisp.ties).
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
