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

// The cheapest of the next and the last `window` rows of `order` for each of these to merge with, by the price of
// merge_costs.py; itself where none is near. A row of the table: place 3, covariance 6, volume, mass, opacity, colour 3.
typedef struct {
  sw_head head;
  const float* table;     // [rows, 15]
  const float* sh;        // [rows, width] coefficients, band 0 first
  const float* weights;   // [rows] or null
  const int64_t* order;   // [n] rows that may merge, along a curve
  int64_t rows, n, width;
  int64_t window, wave;
  double near;            // squared Mahalanobis distance
  float* prices;          // [n, window]
  float* best;            // [n]
  int64_t* partner;       // [n] a place in the order
} merge_partners_call;
SW_OPERATION(splatwizard_gaussians, merge_partners);

// One Gaussian in place of each pair of rows, by merge_groups of merging.py and the ink rule; it stands in the first row.
typedef struct {
  sw_head head;
  float* means;           // [rows, 3]
  float* scales;          // [rows, 3] standard deviations
  float* quats;           // [rows, 4]
  float* opacities;       // [rows]
  float* sh;              // [rows, width]
  float* table;           // [rows, 15] as above; the first row of each pair is written
  const int64_t* pairs;   // [n, 2] no row twice
  int64_t rows, n, width;
  double unit;            // size of the scene
  const float* center;    // [3] origin of the places in the table
  int64_t widen;          // 1: grow where opacity 1 is not enough; else 0
} merge_pairs_call;
SW_OPERATION(splatwizard_gaussians, merge_pairs);
