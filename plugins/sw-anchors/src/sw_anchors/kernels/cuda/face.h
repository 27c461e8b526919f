// The kernels of anchors on a GPU: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include "../face.h"

SW_OPERATION(sw_anchors_cuda, spawn);
SW_OPERATION(sw_anchors_cuda, spawn_backward);
SW_OPERATION(sw_anchors_cuda, sample_bits);

// For rows of at most 12 tensors: row rows[i] of a source -> row i of its target; or the other way; or added there, of
// float32.
typedef struct {
  sw_head head;
  const void* sources[12];      // strided; rows without gaps, of 4 bytes a number
  void* targets[12];            // strided, likewise
  int64_t words[12];            // numbers of a row of each
  int64_t source_rows[12];      // numbers from one row to the next
  int64_t target_rows[12];
  int64_t tensors;
  const int64_t* rows;          // [count] each at most once, unless they are added
  int64_t count;
  int64_t cleared;              // rows of the targets that hold zeros first; 0: what was there stays
  int32_t way;                  // 0: gather, 1: scatter, 2: add
} copy_rows_call;
SW_OPERATION(sw_anchors_cuda, copy_rows);

// Features, exp of scales and offsets, each plus noise times the step of its group; and masks of 0 or 1.
typedef struct {
  sw_head head;
  const float* features;        // [count, width]
  const float* log_scales;      // [count, 6]
  const float* offsets;         // [count, 3 * k]
  const float* logits;          // [count, k] of masks
  const float* weights;         // [count, 1] or null: of masks; 1
  const float* valid;           // or null: one number, from which row on masks are 0
  const float* noise;           // [count * (width + 6 + 3 * k)] or null: -1/2 .. 1/2
  const float* steps;           // [step_rows, 3] or null: of each row or of all
  int64_t count, width, k, step_rows;
  double threshold;             // of sigmoid(logit) times weight
  float* values;                // [count, width + 6 + 3 * k]
  float* masks;                 // [count, k]
  float* kept;                  // [count] whether one of an anchor's masks is 1
} row_values_call;
SW_OPERATION(sw_anchors_cuda, row_values);

// The gradients; that of a mask is the one of sigmoid(logit) times its weight.
typedef struct {
  sw_head head;
  const float* features;        // [count, width]
  const float* log_scales;      // [count, 6]
  const float* offsets;         // [count, 3 * k]
  const float* logits;          // [count, k]
  const float* weights;         // [count, 1] or null
  const float* valid;           // or null
  const float* noise;           // [count * (width + 6 + 3 * k)] or null
  const float* steps;           // [step_rows, 3] or null
  int64_t count, width, k, step_rows;
  double threshold;
  const float* by_values;       // [count, width + 6 + 3 * k] or null, strided: rows without gaps, as of the next four
  const float* by_features;     // [count, width] or null, strided: by the same numbers again, as the next two
  const float* by_scales;       // [count, 6] or null, strided
  const float* by_offsets;      // [count, 3 * k] or null, strided
  const float* by_masks;        // [count, k] or null, strided
  int64_t by_rows[5];           // how far apart their rows are
  float* to_features;           // [count, width]
  float* to_log_scales;         // [count, 6]
  float* to_offsets;            // [count, 3 * k]
  float* to_logits;             // [count, k]
  float* to_steps;              // [count, 3] or null: of steps that each row has
} row_values_backward_call;
SW_OPERATION(sw_anchors_cuda, row_values_backward);

// Sizes of what view_networks_backward needs.
typedef struct {
  sw_head head;
  int64_t n;
  int64_t parts;                // out: rows of `partial`
  int64_t part;                 // out: numbers of a row
} view_networks_sizes_call;
SW_OPERATION(sw_anchors_cuda, view_networks_sizes);

// Outputs of the networks of opacity, geometry and colour: a layer with ReLU of features, direction and distance, and a
// layer of outputs; those of opacity after tanh.
typedef struct {
  sw_head head;
  const float* center;          // [3] where anchors are seen from
  const float* positions;       // [n, 3]
  const float* features;        // [n, inputs] strided; rows without gaps, `feature_row` apart
  const float* first[3];        // [units, inputs + 4]
  const float* first_bias[3];   // [units]
  const float* opacity;         // [k, units]
  const float* opacity_bias;    // [k]
  const float* geometry;        // [geometry_count, units]
  const float* geometry_bias;   // [geometry_count]
  const float* color;           // [color_count, units]
  const float* color_bias;      // [color_count]
  int64_t n, inputs, units, k, geometry_count, color_count;
  int64_t feature_row;
  float* alpha;                 // [n, k]
  float* raw_geometry;          // [n, geometry_count]
  float* raw_color;             // [n, color_count]
} view_networks_call;
SW_OPERATION(sw_anchors_cuda, view_networks);

// The gradients; sums are the same each time.
typedef struct {
  sw_head head;
  const float* center;          // [3]
  const float* positions;       // [n, 3]
  const float* features;        // [n, inputs] strided
  const float* first[3];        // [units, inputs + 4]
  const float* first_bias[3];   // [units]
  const float* opacity;         // [k, units]
  const float* opacity_bias;    // [k]
  const float* geometry;        // [geometry_count, units]
  const float* geometry_bias;   // [geometry_count]
  const float* color;           // [color_count, units]
  const float* color_bias;      // [color_count]
  int64_t n, inputs, units, k, geometry_count, color_count;
  int64_t feature_row;
  const float* alpha;           // [n, k]
  const float* by_alpha;        // [n, k] derivatives of the loss
  const float* by_geometry;     // [n, geometry_count]
  const float* by_color;        // [n, color_count]
  float* partial;               // [parts, part] of view_networks_sizes, scratch
  int64_t parts, part;
  float* to_features;           // [n, inputs]
  float* to_parameters;         // [total] weight and bias of both layers of each network, each at a multiple of four
  int64_t total;
} view_networks_backward_call;
SW_OPERATION(sw_anchors_cuda, view_networks_backward);

// Statistics of one view for growing and pruning, added to those of `total` anchors.
typedef struct {
  sw_head head;
  const int64_t* rows;          // [seen] anchors, each at most once
  const float* opacities;       // [seen, k] of their offsets
  const int64_t* drawn;         // [count] Gaussians in 0 .. seen k - 1, each at most once
  const float* gradients;       // [count, 2] by their projected centres
  const int32_t* radii;         // [count] of 0: it does not count
  int64_t seen, k, count, total;
  float* opacity_accum;         // [total] opacities > 0
  float* anchor_denom;          // [total] views in which an anchor was seen
  float* offset_grad_accum;     // [total, k] norms of gradients
  float* offset_denom;          // [total, k] views in which an offset was drawn
} add_statistics_call;
SW_OPERATION(sw_anchors_cuda, add_statistics);
