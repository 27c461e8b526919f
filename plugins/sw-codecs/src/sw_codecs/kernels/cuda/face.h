// The operations of grids and planes on a GPU: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include "../face.h"

// At most 8 features; pairs of them start at multiples of 8 bytes.
SW_OPERATION(sw_codecs_cuda, grid_lookup);
SW_OPERATION(sw_codecs_cuda, grid_backward);
SW_OPERATION(sw_codecs_cuda, signs_lookup);
SW_OPERATION(sw_codecs_cuda, signs_backward);

// How many rows of `partial` plane_bits fills for planes of these sizes.
typedef struct {
  sw_head head;
  int64_t heights[4];
  int64_t widths[4];
  int64_t scales, orientations, channels;
  int64_t parts;            // out
} plane_bits_sizes_call;
SW_OPERATION(sw_codecs_cuda, plane_bits_sizes);

// Bits of planes of one to four scales under spatial models, with all derivatives (plane_bits.h).
typedef struct {
  sw_head head;
  const float* planes[4];   // of each scale [orientations, channels, height, width]
  int64_t heights[4];
  int64_t widths[4];
  int64_t scales, orientations, channels;
  const float* parameters;  // [orientations, 1058]
  float* to_planes[4];      // gradients by the planes, zeros before; none: they do not learn
  float* ordered[4];        // scratch that gives these sums one order; none: they are atomic
  int64_t ordered_counts[4];  // numbers of each: 192 for every 32 values of a plane, of each orientation
  float* partial;           // [orientations, parts, 1060] parts of the gradients by the parameters, of the bits, of 0
  int64_t parts;
} plane_bits_call;
SW_OPERATION(sw_codecs_cuda, plane_bits);

// Features of sites in triplanes of one to four scales: of a scale those of its samples and of all coarser ones.
typedef struct {
  sw_head head;
  const int32_t* cells;     // [count, scales, 3, 4] rows of the scale's table
  const float* weights;     // [count, scales, 3, 4]
  int64_t count, scales;
  const float* planes[4];   // of each scale [3, channels, places]
  int64_t places[4];
  int64_t channels;
  double gain;              // planes are rounded to multiples of 1 / gain; 0: they are not
  float* tables[4];         // scratch, of each scale [3 * places, channels]
  float* features;          // [count, width]
  int64_t width;            // scales * 3 * channels
} triplane_lookup_call;
SW_OPERATION(sw_codecs_cuda, triplane_lookup);

// Gradients by the planes from those by the features. Fastest if neighbours follow each other.
typedef struct {
  sw_head head;
  const int32_t* cells;     // [count, scales, 3, 4]
  const float* weights;     // [count, scales, 3, 4]
  const float* slopes;      // [count, width]
  int64_t count, scales, width;
  int64_t places[4];
  int64_t channels;
  const float* largest;     // or null: one number that no slope exceeds, for sums that are the same in any order
  float* tables[4];         // zeros, of each scale [3 * places, channels]; with `largest` none
  int64_t* sums[4];         // with `largest` these instead
  float* to_planes[4];      // of each scale [3, channels, places]
} triplane_backward_call;
SW_OPERATION(sw_codecs_cuda, triplane_backward);
