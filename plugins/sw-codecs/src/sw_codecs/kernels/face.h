// The operations of grids, planes, Huffman codes and codebooks: what C and Python call. See <splatwizard/c_face.h> for
// the form, kernels.h for what they compute.
//
// A grid has `levels` levels over its axes: of each `scales`, last vertices, first entries of its table and whether it is
// dense. `log2_size`: of a hashed table.
#pragma once
#include <splatwizard/c_face.h>

// Features of places.
typedef struct {
  sw_head head;
  const float* x;           // [count, axes]
  const float* values;      // [entries, features]
  int64_t count, axes, entries, features;
  double scales[32];
  int64_t lasts[32];
  int64_t starts[32];
  int64_t dense[32];
  int64_t levels;
  int64_t log2_size;
  float* found;             // [count, width]
  int64_t width;            // levels * features
} grid_lookup_call;
SW_OPERATION(sw_codecs, grid_lookup);

// Adds gradients to a table.
typedef struct {
  sw_head head;
  const float* x;           // [count, axes]
  const float* gradient;    // [count, width]
  int64_t count, axes, entries, features;
  double scales[32];
  int64_t lasts[32];
  int64_t starts[32];
  int64_t dense[32];
  int64_t levels;
  int64_t log2_size;
  float* table;             // [entries, features]
  int64_t width;            // levels * features
  const float* largest;     // or null: on a GPU one number that none of `gradient` exceeds, for sums the same in any order
  int64_t* sums;            // [entries, features] or null: with it zeros
} grid_backward_call;
SW_OPERATION(sw_codecs, grid_backward);

// Features of signs, into columns of `found` from `first` on.
typedef struct {
  sw_head head;
  const float* x;           // [count, columns]
  const float* table;       // [entries, features] numbers whose signs are looked up
  int64_t count, columns, entries, features;
  int64_t axes[3];          // columns of x
  int64_t dimensions;       // how many of them
  double scales[32];
  int64_t lasts[32];
  int64_t starts[32];
  int64_t dense[32];
  int64_t levels;
  int64_t log2_size;
  float* found;             // [count, row]
  int64_t row;
  int64_t first;
} signs_lookup_call;
SW_OPERATION(sw_codecs, signs_lookup);

// Adds to a table the gradients by its signs, from columns of those by features.
typedef struct {
  sw_head head;
  const float* x;           // [count, columns]
  float* table;             // [entries, features]
  int64_t count, columns, entries, features;
  int64_t axes[3];          // columns of x
  int64_t dimensions;       // how many of them
  double scales[32];
  int64_t lasts[32];
  int64_t starts[32];
  int64_t dense[32];
  int64_t levels;
  int64_t log2_size;
  const float* gradient;    // [count, row]
  int64_t row;
  int64_t first;
  const float* largest;     // or null: on a GPU one number that none of `gradient` exceeds, for sums the same in any order
  int64_t* sums;            // [entries, features] or null: with it zeros
} signs_backward_call;
SW_OPERATION(sw_codecs, signs_backward);

// Features of places on planes of one to eight scales.
typedef struct {
  sw_head head;
  const int32_t* cells;     // [count, scales, 3, 4] rows of the scale's table
  const float* weights;     // [count, scales, 3, 4]
  int64_t count, scales;
  const float* tables[8];   // of each scale [rows, channels]
  int64_t rows[8];
  int64_t channels;
  float* found;             // [count, width]
  int64_t width;            // scales * 3 * channels
} sites_lookup_call;
SW_OPERATION(sw_codecs, sites_lookup);

// Adds gradients to the tables of a lookup, which has checked the cells.
typedef struct {
  sw_head head;
  const int32_t* cells;     // [count, scales, 3, 4]
  const float* weights;     // [count, scales, 3, 4]
  int64_t count, scales;
  const float* gradient;    // [count, width]
  int64_t width;            // scales * 3 * channels
  float* tables[8];         // of each scale [rows, channels]
  int64_t channels;
} sites_backward_call;
SW_OPERATION(sw_codecs, sites_backward);

// Symbols of Huffman codes from counts, which are no NaN.
typedef struct {
  sw_head head;
  const uint8_t* bytes;     // [length]
  int64_t length;
  const float* counts;      // [trees, alphabet]
  int64_t trees, alphabet;
  const int64_t* index;     // [count] tree of each symbol
  int32_t* symbols;         // [count]
  int64_t count;
  int32_t sufficed;         // out 0: the bytes end before
} huffman_decode_call;
SW_OPERATION(sw_codecs, huffman_decode);

// The nearest entry of each row.
typedef struct {
  sw_head head;
  const float* rows;        // [count, dimensions]
  const float* entries;     // [choices, dimensions]
  int64_t count, choices, dimensions;
  int64_t* index;           // [count]
  double share;             // out 0..1 of the distances that were computed
} nearest_entries_call;
SW_OPERATION(sw_codecs, nearest_entries);
