// What a training step of wisp computes row by row: what C and
// Python call. See <splatwizard/c_face.h> for the form, rows.h for sizes of rows and the mathematics.
#pragma once
#include <splatwizard/c_face.h>

// Weights as the file has them: q 2^e, |q| <= 127, with the exponent of least squared error for each row.
typedef struct {
  sw_head head;
  const float* weights[16];  // of each matrix, rows by columns
  float* rounded[16];
  int64_t rows[16];
  int64_t columns[16];
  int32_t count;             // matrices
  int32_t lowest;            // exponent
} eight_bits_call;
SW_OPERATION(sw_wisp, eight_bits);

// One of the four blocks of numbers: forecasts from the outputs of its network, and the values as they are drawn, which
// the networks behind it are told.
typedef struct {
  sw_head head;
  int32_t block;             // 0..3: opacity; shape and size; colour; latents
  int32_t phase;             // 0: values as they are, 1: noise, 2: soft rounding, 3: rounding
  double sharpness;
  const float* soft;         // [2] or null: sharpness s and 1 / (2 tanh(s / 2)), read when this runs instead
  bool adaptive;             // whether steps follow the networks
  const float* values;       // [rows, 22]
  const float* noise;        // [rows, 22] or null
  const float* outputs;      // [rows, 56]
  float* inputs;             // [rows, 79] features, then the known numbers in base steps
  float* view_inputs;        // [rows, 79] the same for the network of the latents
  const float* base_steps;   // [22]
  const float* multipliers;  // [128]
  const float* ties[5];
  int64_t rows;
  float* mean;               // [rows, 22]
  float* scale;              // [rows, 22]
  float* steps;              // [rows, 22]
  float* drawn;              // [rows, 22]
  float* told;               // [rows, 42] residuals and their sizes, which ties follow
} draw_call;
SW_OPERATION(sw_wisp, draw);

// Gradients by outputs and values from those by what `draw` wrote, all blocks at once.
typedef struct {
  sw_head head;
  int32_t phase;
  double sharpness;
  const float* soft;         // [2] or null
  bool adaptive;
  bool moves_steps;          // whether steps have a gradient
  const float* values;       // [rows, 22]
  const float* noise;        // [rows, 22] or null
  const float* outputs;      // [rows, 56]
  const float* base_steps;   // [22]
  int64_t rows;
  const float* mean;         // [rows, 22]
  const float* steps;        // [rows, 22]
  const float* by_mean;      // [rows, 22] or null
  const float* by_scale;     // [rows, 22] or null
  const float* by_steps;     // [rows, 22] or null
  const float* by_drawn;     // [rows, 22] or null
  float* to_outputs;         // [rows, 56]
  float* to_values;          // [rows, 22]
} draw_backward_call;
SW_OPERATION(sw_wisp, draw_backward);

// Bits of the bins around drawn values, of the last rows.
typedef struct {
  sw_head head;
  const float* values;       // [rows, 22]
  const float* mean;         // [rows, 22]
  const float* scale;        // [rows, 22]
  const float* steps;        // [rows, 22]
  int64_t rows;
  int64_t last;              // rows that are counted
  float* bits;               // [last, 22]
} bits_call;
SW_OPERATION(sw_wisp, bits);

// Gradients of all rows from those by the bits.
typedef struct {
  sw_head head;
  const float* values;       // [rows, 22]
  const float* mean;         // [rows, 22]
  const float* scale;        // [rows, 22]
  const float* steps;        // [rows, 22]
  int64_t rows;
  int64_t last;
  const float* by_bits;      // [last, 22]
  float* to_values;          // [rows, 22]
  float* to_mean;            // [rows, 22]
  float* to_scale;           // [rows, 22]
  float* to_steps;           // [rows, 22]
} bits_backward_call;
SW_OPERATION(sw_wisp, bits_backward);

// exp(2L) of shapes and sizes, opacities, and SH band 0.
typedef struct {
  sw_head head;
  const float* values;       // [rows, 22] numbers of splats
  const float* log_edges;    // [rows] of their cells
  double low, high;          // bounds of the eigenvalues of L
  int64_t rows;
  float* covariances;        // [rows, 6]
  float* opacities;          // [rows]
  float* dc;                 // [rows, 3]
  float* axes;               // [rows, 12] eigenvalues, then coordinates of the eigenvectors
} splats_call;
SW_OPERATION(sw_wisp, splats);

// Gradients by the numbers.
typedef struct {
  sw_head head;
  double low, high;
  int64_t rows;
  const float* axes;            // [rows, 12]
  const float* opacities;       // [rows]
  const float* by_covariances;  // [rows, 6] or null
  const float* by_opacities;    // [rows] or null
  const float* by_dc;           // [rows, 3] or null
  const float* by_colour;       // [rows, 15] or null: by colour and latents, from the SH bands above 0
  float* to_values;             // [rows, 22]
} splats_backward_call;
SW_OPERATION(sw_wisp, splats_backward);
