// Running means of wisp (sw_wisp.pyramid): what C and Python call. See <splatwizard/c_face.h> for the form.
//
// Cells are those that two splats or more lie in, level after level; cell 0 is the root, `parent` of it is no cell.
// Sums and means of a part of the numbers: c values, then c activities; sums end with the count of splats.
#pragma once
#include <splatwizard/c_face.h>

// Features of some splats.
typedef struct {
  sw_head head;
  const int64_t* rows;        // [n] of the splats
  const int64_t* levels;      // [splats] 3 .. 18
  const int64_t* leaf;        // [splats] finest cell around each
  const int64_t* parent;      // [cells + 1]
  const int64_t* depth;       // [cells] level of each
  const int64_t* starts;      // [17] first cell of each level, and how many there are
  const double* base_prior;   // [20]
  const double* view_prior;   // [24]
  const double* base_sums;    // [cells + 1, 21] or null: nothing is known
  const double* view_sums;    // [cells + 1, 25] or null
  bool* needed;               // [cells] scratch
  double* means;              // [cells, 44] scratch
  int64_t n, splats, cells;
  int64_t* found;             // [n, 69]
} pyramid_features_call;
SW_OPERATION(sw_wisp_exact, pyramid_features);

// Adds values to the own numbers of splats and to the sums of all cells around them: with indices values within +-2^20,
// activities, and a count; else differences, to columns `first` and on.
typedef struct {
  sw_head head;
  const int64_t* rows;        // [n]
  const int64_t* leaf;        // [splats]
  const int64_t* parent;      // [cells + 1]
  const int64_t* values;      // [n, columns]
  const int64_t* indices;     // [n, columns] or null
  int64_t first;              // column of the sums that values begin at
  int64_t n, splats, cells, columns, width;
  float* own;                 // [splats, width]
  double* sums;               // [cells + 1, width]
} pyramid_add_call;
SW_OPERATION(sw_wisp_exact, pyramid_add);
