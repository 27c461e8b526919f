// The fused operations of training on a GPU: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include "../face.h"

// total = offset + l1_weight * l1 + ssim_weight * ssim of two images, and its gradient; the host waits for nothing.
typedef struct {
  sw_head head;
  const float* x;         // [planes, height, width] the image that is trained
  const float* y;         // [planes, height, width] the picture
  int64_t planes, height, width;
  bool valid;             // SSIM only where the window lies inside the image; otherwise zero padding
  double l1_weight, ssim_weight, offset;
  float* found;           // [3] total, the mean of |x-y|, the mean of the SSIM map
  float* grad;            // [planes, height, width] or null: of the total by x
  float* scratch;         // [scratch_count] two, and two for each 32 x 32 pixels of each plane; three for each pixel if
  int64_t scratch_count;  //   there is a gradient
} photometric_loss_call;
SW_OPERATION(splatwizard_training_cuda, photometric_loss);

// One step of Adam of all, 24 in a launch; tensors start at multiples of 16 bytes.
SW_OPERATION(splatwizard_training_cuda, adam);
