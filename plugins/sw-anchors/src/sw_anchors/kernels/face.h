// The kernels of anchors: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include <splatwizard/c_face.h>

// The Gaussians `drawn`, from the outputs of networks of n anchors with k offsets each (spawn.h).
typedef struct {
  sw_head head;
  const float* alpha;           // [n, k] opacities before masks
  const float* geometry;        // [n, 7 * k] outputs of the covariance network
  const float* color;           // [n, 3 * k] before the sigmoid
  const float* positions;       // [n, 3]
  const float* offsets;         // [n, k, 3] strided; rows without gaps, `offset_row` apart
  const float* scales;          // [n, 6] strided; rows without gaps, `scale_row` apart
  const float* masks;           // [n, k] or null
  const int64_t* drawn;         // [count] ascending numbers of Gaussians in 0 .. n k - 1
  int64_t n, k, count;
  int64_t offset_row, scale_row;
  float* means;                 // [count, 3]
  float* opacities;             // [count]
  float* sizes;                 // [count, 3]
  float* quats;                 // [count, 4]
  float* colors;                // [count, 3]
} spawn_call;
SW_OPERATION(sw_anchors, spawn);

// The gradients of spawn, in the order of the Gaussians of an anchor, whatever the number of threads.
typedef struct {
  sw_head head;
  const float* alpha;           // [n, k]
  const float* geometry;        // [n, 7 * k]
  const float* color;           // [n, 3 * k]
  const float* positions;       // [n, 3]
  const float* offsets;         // [n, k, 3] strided
  const float* scales;          // [n, 6] strided
  const float* masks;           // [n, k] or null
  const int64_t* drawn;         // [count]
  int64_t n, k, count;
  int64_t offset_row, scale_row;
  const float* by_means;        // [count, 3] derivatives of the loss
  const float* by_opacities;    // [count]
  const float* by_sizes;        // [count, 3]
  const float* by_quats;        // [count, 4]
  const float* by_colors;       // [count, 3]
  float* to_alpha;              // [n, k] zeros before, as all that follow
  float* to_geometry;           // [n, 7 * k]
  float* to_color;              // [n, 3 * k]
  float* to_offsets;            // [n, k, 3]
  float* to_scales;             // [n, 6]
  float* to_masks;              // [n, k] or null
  float* to_positions;          // [n, 3] or null
  bool ordered;                 // on a GPU: sums of an anchor have one order; on the CPU they always have
} spawn_backward_call;
SW_OPERATION(sw_anchors, spawn_backward);

// Hidden layers of `units` numbers in each of the three networks stand in blocks of anchors, in rows of all three.
typedef struct {
  sw_head head;
  int64_t units;
  int64_t block;                // out: anchors; there is room for whole blocks
  int64_t width;                // out: numbers of a row
} heads_sizes_call;
SW_OPERATION(sw_anchors, heads_sizes);

// Opacities that the networks of n anchors give. Networks are those of opacity, geometry and colour: a layer with ReLU
// of features, direction and distance, and a layer of outputs.
typedef struct {
  sw_head head;
  const float* center;          // [3] where anchors are seen from
  const float* positions;       // [n, 3]
  const float* features;        // [n, inputs] strided; rows without gaps, `feature_row` apart
  const float* masks;           // [n, k] or null
  const float* first[3];        // [units, inputs + 4]
  const float* first_bias[3];   // [units]
  const float* opacity;         // [k, units]
  const float* opacity_bias;    // [k]
  const float* geometry;        // [7 * k, units]
  const float* geometry_bias;   // [7 * k]
  const float* color;           // [3 * k, units]
  const float* color_bias;      // [3 * k]
  int64_t n, k, inputs, units;
  int64_t feature_row;
  float* hidden;                // [rows, width] of heads_sizes
  int64_t rows, width;
  float* alpha;                 // [n, k] before masks
  float* opacities;             // [n, k]
  int64_t count;                // out: opacities > 0
} heads_opacities_call;
SW_OPERATION(sw_anchors, heads_opacities);

// The `count` Gaussians of opacity > 0, and what heads_backward needs.
typedef struct {
  sw_head head;
  const float* positions;       // [n, 3]
  const float* offsets;         // [n, k, 3] strided
  const float* scales;          // [n, 6] strided
  const float* masks;           // [n, k] or null
  const float* first[3];        // [units, inputs + 4]
  const float* first_bias[3];   // [units]
  const float* opacity;         // [k, units]
  const float* opacity_bias;    // [k]
  const float* geometry;        // [7 * k, units]
  const float* geometry_bias;   // [7 * k]
  const float* color;           // [3 * k, units]
  const float* color_bias;      // [3 * k]
  int64_t n, k, inputs, units;
  int64_t offset_row, scale_row;
  const float* hidden;          // [rows, width]
  int64_t rows, width;
  const float* alpha;           // [n, k]
  const float* all_opacities;   // [n, k]
  int64_t count;
  int64_t* drawn;               // [count] their numbers
  float* raw_geometry;          // [count, 7] outputs of the networks
  float* raw_color;             // [count, 3]
  float* means;                 // [count, 3]
  float* opacities;             // [count]
  float* sizes;                 // [count, 3]
  float* quats;                 // [count, 4]
  float* colors;                // [count, 3]
} heads_spawn_call;
SW_OPERATION(sw_anchors, heads_spawn);

// The gradients of both; sums of weights are the same for any number of threads.
typedef struct {
  sw_head head;
  const float* center;          // [3]
  const float* positions;       // [n, 3]
  const float* features;        // [n, inputs] strided
  const float* offsets;         // [n, k, 3] strided
  const float* scales;          // [n, 6] strided
  const float* masks;           // [n, k] or null
  const float* first[3];        // [units, inputs + 4]
  const float* first_bias[3];   // [units]
  const float* opacity;         // [k, units]
  const float* opacity_bias;    // [k]
  const float* geometry;        // [7 * k, units]
  const float* geometry_bias;   // [7 * k]
  const float* color;           // [3 * k, units]
  const float* color_bias;      // [3 * k]
  int64_t n, k, inputs, units;
  int64_t feature_row, offset_row, scale_row;
  const float* hidden;          // [rows, width]
  int64_t rows, width;
  const float* alpha;           // [n, k]
  const int64_t* drawn;         // [count]
  int64_t count;
  const float* raw_geometry;    // [count, 7]
  const float* raw_color;       // [count, 3]
  const float* by_means;        // [count, 3] derivatives of the loss
  const float* by_opacities;    // [count]
  const float* by_sizes;        // [count, 3]
  const float* by_quats;        // [count, 4]
  const float* by_colors;       // [count, 3]
  float* scratch_alpha;         // [n, k]
  float* scratch_geometry;      // [count, 7]
  float* scratch_color;         // [count, 3]
  float* to_features;           // [n, inputs]
  float* to_offsets;            // [n, k, 3] zeros before
  float* to_scales;             // [n, 6] zeros before
  float* to_masks;              // [n, k] or null, zeros before
  float* to_first[3];           // [units, inputs + 4]
  float* to_first_bias[3];      // [units]
  float* to_opacity;            // [k, units]
  float* to_opacity_bias;       // [k]
  float* to_geometry;           // [7 * k, units]
  float* to_geometry_bias;      // [7 * k]
  float* to_color;              // [3 * k, units]
  float* to_color_bias;         // [3 * k]
} heads_backward_call;
SW_OPERATION(sw_anchors, heads_backward);

// Values of some rows of tables, with noise, and the masks; all numbers of those that are drawn (values.h).
typedef struct {
  sw_head head;
  const int64_t* rows;          // [count] each at most once
  const float* features;        // [total, width]
  const float* log_scales;      // [total, 6]
  const float* offsets;         // [total, k, 3]
  const float* mask_logits;     // [total, k]
  const float* mask_weights;    // [total, 1] or null
  const float* steps;           // [step_rows, 3] or null: widths of noise, of each row or of all
  const float* uniform;         // [count, width + 6 + 3 * k] or null, draws of U(0, 1)
  const int64_t* drawn;         // [samples] ascending places in `rows`
  int64_t count, total, width, k, step_rows, samples;
  double threshold;
  float* to_features;           // [count, width]
  float* to_scales;             // [count, 6]
  float* to_offsets;            // [count, k, 3]
  float* to_masks;              // [count, k]
  float* to_sample;             // [samples, width + 6 + 3 * k]
} noisy_values_call;
SW_OPERATION(sw_anchors, noisy_values);

// The gradients of the tables, and of steps that rows have of their own.
typedef struct {
  sw_head head;
  const int64_t* rows;          // [count]
  const float* features;        // [total, width]
  const float* log_scales;      // [total, 6]
  const float* offsets;         // [total, k, 3]
  const float* mask_logits;     // [total, k]
  const float* mask_weights;    // [total, 1] or null
  const float* steps;           // [step_rows, 3] or null
  const float* uniform;         // [count, width + 6 + 3 * k] or null
  const int64_t* drawn;         // [samples]
  int64_t count, total, width, k, step_rows, samples;
  double threshold;
  const float* by_features;     // [count, width] derivatives of the loss
  const float* by_scales;       // [count, 6]
  const float* by_offsets;      // [count, k, 3]
  const float* by_masks;        // [count, k]
  const float* by_sample;       // [samples, width + 6 + 3 * k]
  float* to_features;           // [total, width] zeros before, as the next three
  float* to_log_scales;         // [total, 6]
  float* to_offsets;            // [total, k, 3]
  float* to_mask_logits;        // [total, k]
  float* to_steps;              // [count, 3] or null
} noisy_values_backward_call;
SW_OPERATION(sw_anchors, noisy_values_backward);

// Quantiser steps that a network predicts: base max(offset + tanh(output), smallest).
typedef struct {
  sw_head head;
  const float* features;        // [count, inputs]
  const float* first;           // [units, inputs]
  const float* first_bias;      // [units]
  const float* last;            // [3, units]
  const float* last_bias;       // [3]
  const float* base;            // [3]
  int64_t count, inputs, units;
  double offset;
  double smallest;
  float* steps;                 // [count, 3]
  float* hidden;                // [count, units] the layer with ReLU
  float* tangents;              // [count, 3] tanh(output)
} predicted_steps_call;
SW_OPERATION(sw_anchors, predicted_steps);

// The gradients of steps and hidden layer; sums are the same for any number of threads.
typedef struct {
  sw_head head;
  const float* features;        // [count, inputs]
  const float* first;           // [units, inputs]
  const float* first_bias;      // [units]
  const float* last;            // [3, units]
  const float* last_bias;       // [3]
  const float* base;            // [3]
  int64_t count, inputs, units;
  double offset;
  double smallest;
  const float* hidden;          // [count, units]
  const float* tangents;        // [count, 3]
  const float* by_steps;        // [count, 3] derivatives of the loss
  const float* by_hidden;       // [count, units]
  float* to_features;           // [count, inputs]
  float* to_first;              // [units, inputs]
  float* to_first_bias;         // [units]
  float* to_last;               // [3, units]
  float* to_last_bias;          // [3]
} predicted_steps_backward_call;
SW_OPERATION(sw_anchors, predicted_steps_backward);

// Bits of a sample of anchors by group, and the derivatives of their sum. An anchor has features, 6 scales and 3 k
// coordinates of offsets.
typedef struct {
  sw_head head;
  const float* x;               // [count, numbers]
  const float* mean;            // [count, numbers]
  const float* scale;           // [count, numbers]
  const float* steps;           // [count, 3]
  const float* counted;         // [count] 1 where an anchor counts
  const float* masks;           // [count, k]
  int64_t count, numbers, k;
  double smallest;              // probability
  double smallest_scale;        // floor of the deviations
  float* bits;                  // [count, 3]
  float* to_x;                  // [count, numbers]
  float* to_mean;               // [count, numbers]
  float* to_scale;              // [count, numbers]
  float* to_steps;              // [count, 3]
  float* to_masks;              // [count, k]
} sample_bits_call;
SW_OPERATION(sw_anchors, sample_bits);
