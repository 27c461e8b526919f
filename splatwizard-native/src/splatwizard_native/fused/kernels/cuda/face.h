// The fused operations of training on a GPU: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include "../face.h"

// total = offset + l1_weight * l1 + ssim_weight * ssim of two images; the host waits for none of them.
typedef struct {
  sw_head head;
  const float* x;         // [planes, height, width] the image that is trained
  const float* y;         // [planes, height, width] the picture
  int64_t planes, height, width;
  bool valid;             // SSIM only where the window lies inside the image; otherwise zero padding
  double l1_weight, ssim_weight, offset;
  float* total;           // one number
  float* l1;              // one number: the mean of |x-y|
  float* ssim;            // one number: the mean of the SSIM map
  float* slopes;          // [3, planes, height, width] or null: what the backward pass needs
  float* sums;            // [sum_count] scratch: two, and two for each 32 x 32 pixels of each plane, or more
  int64_t sum_count;
} photometric_loss_call;
SW_OPERATION(splatwizard_training_cuda, photometric_loss);

// The gradient of a loss by x, from that by `total`.
typedef struct {
  sw_head head;
  const float* x;         // [planes, height, width]
  const float* y;         // [planes, height, width]
  const float* slopes;    // [3, planes, height, width] of `photometric_loss` with the same images and weights
  int64_t planes, height, width;
  bool valid;
  double l1_weight, ssim_weight;
  const float* scale;     // or null: one number, or 1
  float* grad;            // [planes, height, width]
} photometric_loss_backward_call;
SW_OPERATION(splatwizard_training_cuda, photometric_loss_backward);

// One step of Adam of all, 24 in a launch; tensors start at multiples of 16 bytes.
SW_OPERATION(splatwizard_training_cuda, adam);
