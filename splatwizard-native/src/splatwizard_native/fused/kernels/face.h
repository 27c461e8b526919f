// The fused operations of training: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include <splatwizard/c_face.h>

// Means of |x-y| and of the SSIM map of two images, and the gradient of l1_weight * l1 + ssim_weight * ssim.
typedef struct {
  sw_head head;
  const float* x;         // [planes, height, width] the image that is trained
  const float* y;         // [planes, height, width] the picture
  int64_t planes, height, width;
  int32_t valid;          // 1: SSIM only where the window lies inside the image; 0: zero padding
  double l1_weight;
  double ssim_weight;
  float* grad;            // [planes, height, width] or null, of x
  double* row_sums;       // [2, planes, height] scratch
  double l1;              // out
  double ssim;            // out
} photometric_call;
SW_OPERATION(splatwizard_training, photometric);

// One parameter with its gradient and state, `count` contiguous numbers each, and the constants of its update.
typedef struct {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  int64_t count;
  double lr;
  double beta1;
  double beta2;
  double eps;
  int64_t step;           // of this update, from 1
} adam_update;

// One step of Adam of all.
typedef struct {
  sw_head head;
  const adam_update* updates;
  int64_t count;
} adam_call;
SW_OPERATION(splatwizard_training, adam);
