// The kernels on CUDA: plain pointers and a stream, no torch.
#pragma once
#include <cuda_runtime_api.h>

#include <cstdint>

namespace splatwizard::cuda {

// Adds one view to the statistics of adaptive density control; Gaussians with radius 0 are left alone.
struct Statistics {
  const float* gradients;  // [count, 2] NDC units, 8-byte aligned
  const int32_t* radii;    // [count] pixels
  float* grad_accum;       // [count] += length of the gradient
  float* denom;            // [count] += 1
  float* max_radii;        // [count] pixels
  int64_t count;
};

void statistics(const Statistics& args, cudaStream_t stream);

// Adds one view to the sums of opacity gradients over fragments, [count, 3]: g / (1 - opacity), and `fragments`.
struct FragmentStatistics {
  const float* gradients;  // [count] g, by the logits
  const float* logits;     // [count] of the opacities
  const float* fragments;  // [count, 2] 8-byte aligned
  float* sums;             // [count, 3]
  float least_clear;       // floor of 1 - opacity
  int64_t count;
};

void fragment_statistics(const FragmentStatistics& args, cudaStream_t stream);

// Adam of the marked rows of a [rows, width] parameter; 16-byte aligned.
struct SparseAdamTensor {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  int64_t width;  // below 2^20
  float lr, one_minus_beta1, beta2, one_minus_beta2, eps;
};

constexpr int kSparseAdamTensors = 16;  // of one launch

void sparse_adam(const SparseAdamTensor* tensors, int count, const bool* mask, int64_t rows, cudaStream_t stream);

// Normals that were drawn beside those of a depth map, both in the camera's frame; all maps [height, width].
struct Surface {
  const float* depth;    // camera z, 0 = no surface
  const float* normals;  // [3, height, width] sums of weighted unit normals
  const float* alpha;
  int32_t width, height;
  float fx, fy, cx, cy;  // pixels
};

// disagreement = 1 - alpha normals . (unit normal of the depth map); 1 on the border of one pixel
void disagreement(const Surface& surface, float* disagreement, cudaStream_t stream);

// The derivatives of a loss by depth and normals from that by the disagreement, `grad`.
void disagreement_backward(const Surface& surface, const float* grad, float* to_depth, float* to_normals,
                           cudaStream_t stream);

}  // namespace splatwizard::cuda
