// The kernels of HAC: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include <splatwizard/c_face.h>

// Bits of a sample of anchors under predicted distributions, by group, and the derivatives of their sum (mixture.h).
typedef struct {
  sw_head head;
  const float* x;               // [count, numbers]
  const float* outputs;         // [count, width]
  const float* units;           // [width] factors of the outputs
  const int32_t* columns;       // [3, features] or null: where a feature has mean, deviation and logit in a row of `second`
  const float* second;          // [count, 3 * features] or null: a second Gaussian of each feature
  const float* steps;           // [count, 3]
  const float* masks;           // [count, k]
  const float* counted;         // [count] factors of the bits of an anchor
  int64_t count, numbers, width, features, k;
  double base;                  // step that `second` counts in
  double smallest;              // probability
  double smallest_scale;        // of a deviation, without gradient below
  double scale_floor;           // of a deviation in steps instead; 0: none
  int32_t kind;                 // MaskKind
  float* bits;                  // [count, 3]
  float* to_x;                  // [count, numbers]
  float* to_outputs;            // [count, width]
  float* to_steps;              // [count, 3]
  float* to_masks;              // [count, k]
  float* to_second;             // [count, 3 * features] or null
} mixture_bits_call;
SW_OPERATION(sw_hac, mixture_bits);

// Inputs of the networks of channels.
typedef struct {
  sw_head head;
  const float* x;               // [count, numbers]
  const float* outputs;         // [count, width]
  const float* units;           // [width]
  int64_t count, numbers, width, features;
  double base;
  bool context;                 // whether they see the prediction of the first Gaussian
  float* inputs;                // [count, columns] features, perhaps context, then a one and zeros, to whole fours
  int64_t columns;
} channel_inputs_call;
SW_OPERATION(sw_hac, channel_inputs);

// Derivatives by x and outputs from those of the bits, among them what comes through the networks of channels.
typedef struct {
  sw_head head;
  const float* slope;           // one number: the derivative by the bits
  const float* by_x;            // [count, numbers]
  const float* by_outputs;      // [count, width]
  const float* by_inputs;       // [count, columns] or null
  const float* units;           // [width]
  int64_t count, numbers, width, features, columns;
  double base;
  bool context;
  float* to_x;                  // [count, numbers]
  float* to_outputs;            // [count, width]
} channel_slopes_call;
SW_OPERATION(sw_hac, channel_slopes);
