// The kernels of training Gaussians: what C and Python call. See <splatwizard/c_face.h> for the form.
#pragma once
#include <splatwizard/c_face.h>

// One parameter with its gradient and moments, [rows, width] without gaps, and the constants of its update.
typedef struct {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  int64_t width;
  double lr, beta1, beta2, eps;
} sparse_update;

// One step of Adam, without bias correction, of the rows of all that are marked.
typedef struct {
  sw_head head;
  const sparse_update* updates;
  int64_t count;
  const bool* marked;     // [rows]
  int64_t rows;
} sparse_adam_call;
SW_OPERATION(splatwizard_gaussians, sparse_adam);
