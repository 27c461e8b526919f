// The kernels of training Gaussians on a GPU: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include "../face.h"

// One step of Adam, 16 tensors in a launch, which start at multiples of 16 bytes; rows are shorter than 2^20.
SW_OPERATION(splatwizard_gaussians_cuda, sparse_adam);

// Adds one view to the statistics of adaptive density control; Gaussians with radius 0 are left alone.
typedef struct {
  sw_head head;
  const float* gradients; // [rows, 2] NDC units, at a multiple of 8 bytes
  const int32_t* radii;   // [rows] pixels
  int64_t rows;
  float* grad_accum;      // [rows] += length of the gradient
  float* denom;           // [rows] += 1
  float* max_radii;       // [rows] pixels
} view_statistics_call;
SW_OPERATION(splatwizard_gaussians_cuda, view_statistics);

// Adds one view to the sums of opacity gradients over fragments: g / (1 - opacity), and `fragments`.
typedef struct {
  sw_head head;
  const float* gradients; // [rows] g, by the logits
  const float* logits;    // [rows] of the opacities
  const float* fragments; // [rows, 2] at a multiple of 8 bytes
  int64_t rows;
  double least_clear;     // floor of 1 - opacity
  float* sums;            // [rows, 3]
} fragment_statistics_call;
SW_OPERATION(splatwizard_gaussians_cuda, fragment_statistics);

// 1 - alpha normals . (unit normal of the depth map); 1 on the border of one pixel.
typedef struct {
  sw_head head;
  const float* depth;     // [1, height, width] camera z, 0 = no surface
  const float* normals;   // [3, height, width] sums of weighted unit normals, of the camera's frame
  const float* alpha;     // [1, height, width]
  int64_t height, width;
  double fx, fy, cx, cy;  // pixels
  float* found;           // [1, height, width]
} disagreement_call;
SW_OPERATION(splatwizard_gaussians_cuda, disagreement);

// The derivatives of a loss by depth and normals, from that by the disagreement.
typedef struct {
  sw_head head;
  const float* grad;      // [1, height, width]
  const float* depth;     // [1, height, width]
  const float* normals;   // [3, height, width]
  const float* alpha;     // [1, height, width]
  int64_t height, width;
  double fx, fy, cx, cy;
  float* to_depth;        // [1, height, width]
  float* to_normals;      // [3, height, width]
} disagreement_backward_call;
SW_OPERATION(splatwizard_gaussians_cuda, disagreement_backward);
