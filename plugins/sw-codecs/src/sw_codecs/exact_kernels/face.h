// The operations of the exact mode: what C and Python call. See <splatwizard/c_face.h> for the form.
//
// Tables of counts as shares of 2^24 (kernels.h, Tables): `shares`, `first`, `radius`, `bucket`. A `status` is one of
// kernels.h. Where not all numbers of rows are `present`, those that are follow one another.
#pragma once
#include <splatwizard/c_face.h>

// Integer parts of means and numbers of tables, of the present numbers.
typedef struct {
  sw_head head;
  const int64_t* mean;        // [rows, columns] strided
  const int64_t* scale;       // [rows, columns] strided
  const int64_t* multiplier;  // [rows, 1] strided
  int64_t mean_stride, scale_stride, multiplier_stride;  // from row to row; numbers of a row have no gaps
  const bool* present;        // [rows, columns] or null: all
  int64_t* start;             // [rows] or null, scratch; needed with present
  int64_t rows, columns;
  const int64_t* thresholds;  // [63]
  int32_t* centre;            // [count]
  int16_t* number;            // [count]
  int64_t count;
  int32_t status;             // out
} lattice_call;
SW_OPERATION(sw_codecs_exact, lattice);

// The present ones of centres and numbers.
typedef struct {
  sw_head head;
  const int32_t* centre;      // [rows, columns]
  const int16_t* number;      // [rows, columns]
  const bool* present;        // [rows, columns]
  int64_t* start;             // [rows] scratch
  int64_t rows, columns;
  int32_t* to_centre;         // [count]
  int16_t* to_number;         // [count]
  int64_t count;
} present_rows_call;
SW_OPERATION(sw_codecs_exact, present_rows);

// Symbols as integers, 0 where they are not present, and integer * step.
typedef struct {
  sw_head head;
  const int32_t* symbols;     // [count]
  int64_t count;
  const bool* present;        // [rows, columns] or null: all
  int64_t* start;             // [rows] or null, scratch; needed with present
  const double* step;         // [rows, 1]
  int64_t rows, columns;
  float* values;              // [rows, columns] strided
  int64_t values_stride;      // from row to row; numbers of a row have no gaps
  int64_t* integers;          // [rows, columns]
} put_values_call;
SW_OPERATION(sw_codecs_exact, put_values);

// Symbols of streams of 2^16, which lie in `data` one after another.
typedef struct {
  sw_head head;
  const int32_t* shares;      // [entries]
  const int32_t* first;       // [512]
  const int32_t* radius;      // [512]
  const uint16_t* bucket;     // [512, 256]
  const uint8_t* data;        // [bytes]
  int64_t bytes;
  const int64_t* sizes;       // [streams, 3] anything, bytes of words, bytes of escapes
  int64_t* offsets;           // [streams] scratch
  int64_t streams;
  const int32_t* centre;      // [count]
  const int16_t* number;      // [count]
  int32_t* symbols;           // [count]
  int64_t count;
  int32_t status;             // out
} decode_streams_call;
SW_OPERATION(sw_codecs_exact, decode_streams);

// Streams of symbols: `written` bytes of data. A stream of n symbols needs room for 11 n + 20 bytes.
typedef struct {
  sw_head head;
  const int32_t* shares;      // [entries]
  const int32_t* first;       // [512]
  const int32_t* radius;      // [512]
  const uint16_t* bucket;     // [512, 256]
  const int32_t* symbols;     // [count]
  const int32_t* centre;      // [count]
  const int16_t* number;      // [count]
  int64_t count;
  uint8_t* data;              // [room]
  int64_t room;
  int64_t* sizes;             // [streams, 3] the first column is left as it is
  int64_t* offsets;           // [streams] scratch
  int64_t streams;
  int64_t written;            // out
} encode_streams_call;
SW_OPERATION(sw_codecs_exact, encode_streams);

// Integer planes of streams; of each scale int32 [orientations, channels, height, width].
typedef struct {
  sw_head head;
  const int32_t* shares;      // [entries]
  const int32_t* first;       // [512]
  const int32_t* radius;      // [512]
  const uint16_t* bucket;     // [512, 256]
  const uint8_t* data;        // [bytes]
  int64_t bytes;
  const int64_t* sizes;       // [streams, 3] as in decode_streams
  int64_t* offsets;           // [streams] scratch
  const int64_t* parts;       // [streams, 4] scale, orientation, first channel, channels
  int64_t* bundles;           // [streams + 1] scratch
  int64_t streams;
  int32_t* planes[4];
  int64_t channels[4];
  int64_t height[4];
  int64_t width[4];
  int64_t scales;
  const double* weights;      // [orientations, 1058] of each model: W [out, in] and b of its five layers
  int64_t orientations;
  int32_t status;             // out
} decode_planes_call;
SW_OPERATION(sw_codecs_exact, decode_planes);

// Streams of integer planes: `written` bytes of data; room as in encode_streams.
typedef struct {
  sw_head head;
  const int32_t* shares;      // [entries]
  const int32_t* first;       // [512]
  const int32_t* radius;      // [512]
  const uint16_t* bucket;     // [512, 256]
  const int64_t* parts;       // [streams, 4] as in decode_planes
  int64_t* bundles;           // [streams + 1] scratch
  const int32_t* planes[4];
  int64_t channels[4];
  int64_t height[4];
  int64_t width[4];
  int64_t scales;
  const double* weights;      // [orientations, 1058]
  int64_t orientations;
  uint8_t* data;              // [room]
  int64_t room;
  int64_t* sizes;             // [streams, 3] the first column is left as it is
  int64_t* offsets;           // [streams] scratch
  int64_t streams;
  int64_t written;            // out
} encode_planes_call;
SW_OPERATION(sw_codecs_exact, encode_planes);

// Nodes of an octree, and the occupancies of all its levels, one after another.
typedef struct {
  sw_head head;
  const uint8_t* words;       // [bytes]
  int64_t bytes;
  const int64_t* counts;      // [depth, 4, 255] by level and by children of the parent; none empty
  int64_t depth;
  int64_t points;             // no level has more nodes
  int64_t* nodes;             // [points]
  uint8_t* occupancies;       // [depth * points]
  int64_t* sizes;             // [depth + 1] nodes of each level, and at the end; 0 of what is not reached
  int32_t status;             // out
} decode_octree_call;
SW_OPERATION(sw_codecs_exact, decode_octree);

// Bits of which `zeros` of 2^24 are 0.
typedef struct {
  sw_head head;
  const uint8_t* words;       // [bytes]
  int64_t bytes;
  int64_t zeros;
  int32_t* bits;              // [count]
  int64_t count;
  int32_t status;             // out
} decode_bits_call;
SW_OPERATION(sw_codecs_exact, decode_bits);

// Symbols of several models from one stream of range-coded words: each call goes on where the one before ended, which
// `state` tells: low, range, point and how many words were read.

// Bits, each under its own share of 0.
typedef struct {
  sw_head head;
  const uint8_t* words;       // [bytes]
  int64_t bytes;
  int64_t* state;             // [4]
  const int32_t* zeros;       // [count] 1 .. 2^24 - 1
  bool* bits;                 // [count]
  int64_t count;
  int32_t status;             // out
} range_bits_call;
SW_OPERATION(sw_codecs_exact, range_bits);

// Entries of tables, table by table.
typedef struct {
  sw_head head;
  const int32_t* shares;      // [numbers]
  const int32_t* first;       // [512]
  const int32_t* radius;      // [512]
  const uint16_t* bucket;     // [512, 256]
  const uint8_t* words;       // [bytes]
  int64_t bytes;
  int64_t* state;             // [4]
  const int16_t* number;      // [count] 0 .. 511
  int32_t* entries;           // [count]
  int64_t numbers, count;
  int32_t status;             // out
} range_entries_call;
SW_OPERATION(sw_codecs_exact, range_entries);

// Which of three, under counts of each symbol.
typedef struct {
  sw_head head;
  const uint8_t* words;       // [bytes]
  int64_t bytes;
  int64_t* state;             // [4]
  const double* counts;       // [count, 3] above 0
  int32_t* entries;           // [count]
  int64_t count;
  int32_t status;             // out
} range_choices_call;
SW_OPERATION(sw_codecs_exact, range_choices);

// Cells of splats of a subset, in the order of the file.
typedef struct {
  sw_head head;
  const uint8_t* words;       // [bytes]
  int64_t bytes;
  int64_t* state;             // [4]
  const int32_t* zeros;       // [2960] shares of 0 by level 3 .. 18 and context
  const int64_t* known_start;   // [17] first of the known cells of each level, and how many there are
  const int64_t* known_cells;   // [known] Morton codes, ascending at each level
  const int64_t* known_counts;  // [known] splats of earlier subsets in each
  int64_t known, rows;
  int64_t* levels;            // [rows]
  int64_t* codes;             // [rows] Morton codes at these levels
  int32_t status;             // out
} decode_leaf_octree_call;
SW_OPERATION(sw_codecs_exact, decode_leaf_octree);

// Outputs of a network of integers. Inputs are `inputs` and `further` side by side, or `short_inputs`.
typedef struct {
  sw_head head;
  const int64_t* inputs;      // [rows, columns] or null, strided
  const int64_t* further;     // [rows, more] or null, strided
  int64_t columns, more;
  int64_t stride, further_stride;  // from row to row; numbers of a row have no gaps
  const int16_t* short_inputs;     // [rows, short_columns] or null
  int64_t short_columns;
  const double* weights;      // [numbers] W [out, in] and b [out] of each layer
  int64_t numbers;
  const int64_t* widths;      // [ends] of the inputs, and of the outputs of each layer
  int64_t ends;
  int64_t leak;               // slope of activations below 0, in 1/4096
  int64_t* outputs;           // [rows, last]
  int64_t rows, last;
} network_call;
SW_OPERATION(sw_codecs_exact, network);

// The lattice of what a network says of groups of numbers: means and scales of each, at the end a step of each.
typedef struct {
  sw_head head;
  const int64_t* inputs;      // [rows, columns] or null, strided
  const int64_t* further;     // [rows, more] or null, strided
  int64_t columns, more;
  int64_t stride, further_stride;
  const int16_t* short_inputs;     // [rows, short_columns] or null
  int64_t short_columns;
  const double* weights;      // [numbers] as in network
  int64_t numbers;
  const int64_t* widths;      // [ends]
  int64_t ends;
  int64_t rows;
  const int64_t* multipliers; // [128] 64 .. 16384, by output of the step
  const int64_t* thresholds;  // [63]
  int32_t* centre[4];         // of each group [rows, group_columns]
  int16_t* number[4];         // of each group [rows, group_columns]
  int64_t group_columns[4];
  int64_t* steps;             // [rows, groups] multipliers
  int64_t groups;
  int32_t status;             // out
} forecast_call;
SW_OPERATION(sw_codecs_exact, forecast);

// Columns of a grid of signs, into `found` or `short_found`.
typedef struct {
  sw_head head;
  const int64_t* codes;       // [rows, 3]
  int64_t axes[3];
  int64_t dimensions;         // how many of them
  const uint16_t* signs;      // [entries] bit f: sign f is +1
  int64_t entries, features;
  const int64_t* levels;      // [3, depth] resolution - 1, first entry and first column; dense levels first
  int64_t depth, dense, log2_size;
  int64_t* found;             // [rows, width] or null
  int16_t* short_found;       // [rows, width] or null
  int64_t rows, width;
} grid_features_call;
SW_OPERATION(sw_codecs_exact, grid_features);

// Features of places in planes of one to four scales.
typedef struct {
  sw_head head;
  const int64_t* places;      // [rows, 3] in 0 .. 2^20
  const int32_t* planes[4];   // of each scale [3, size * size, channels]
  int64_t sizes[4];
  int64_t scales, channels;
  int64_t* found;             // [rows, width] width: scales * 3 * channels
  int64_t rows, width;
} triplane_features_call;
SW_OPERATION(sw_codecs_exact, triplane_features);

// Entries of numbers under mixtures of two tables (mixtures.h, MixtureArgs).
typedef struct {
  sw_head head;
  const double* below;        // [sums]
  const double* escape;       // [512]
  const int32_t* first;       // [512]
  const int32_t* radius;      // [512]
  const int32_t* order;       // [count]
  const int32_t* half_width;  // [count]
  const int32_t* shift;       // [count, 2]
  const int16_t* number;      // [count, 2]
  const int32_t* weight;      // [count]
  int64_t count;
  const uint8_t* words;       // [bytes]
  int64_t bytes;
  int32_t* entries;           // [count]
  int32_t status;             // out
} decode_mixtures_call;
SW_OPERATION(sw_codecs_exact, decode_mixtures);

// Range-coded words of entries: `written` bytes, of at most 4 (count + 2).
typedef struct {
  sw_head head;
  const double* below;        // [sums]
  const double* escape;       // [512]
  const int32_t* first;       // [512]
  const int32_t* radius;      // [512]
  const int32_t* order;       // [count]
  const int32_t* half_width;  // [count]
  const int32_t* shift;       // [count, 2]
  const int16_t* number;      // [count, 2]
  const int32_t* weight;      // [count]
  int64_t count;
  const int32_t* entries;     // [count]
  uint8_t* words;             // [room]
  int64_t room;
  int64_t written;            // out
} encode_mixtures_call;
SW_OPERATION(sw_codecs_exact, encode_mixtures);

// What mixtures are made of, for each number of rows.
typedef struct {
  sw_head head;
  const int64_t* parts[5];    // [rows, columns] strided: mean, scale, second mean, second scale, logit
  int64_t strides[5];         // from row to row; numbers of a row have no gaps
  const int64_t* step;        // [rows, 1] strided
  int64_t step_stride;
  int64_t rows, columns;
  const int64_t* multipliers; // [128]
  const int64_t* thresholds;  // [63]
  const int32_t* radius;      // [512]
  const int64_t* half_widths; // [widths] ascending
  int64_t widths;
  int32_t* centre;            // [rows * columns]
  int32_t* width;             // [rows * columns]
  int32_t* order;             // [rows * columns]
  int32_t* shift;             // [rows * columns, 2]
  int16_t* number;            // [rows * columns, 2]
  int32_t* weight;            // [rows * columns]
  int32_t status;             // out
} mixture_rows_call;
SW_OPERATION(sw_codecs_exact, mixture_rows);
