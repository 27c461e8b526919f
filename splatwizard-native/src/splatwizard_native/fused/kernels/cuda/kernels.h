// The training kernels on CUDA: plain pointers and a stream, no torch.
#pragma once
#include <cuda_runtime_api.h>

#include <cstdint>

namespace splatwizard::cuda {

// Two images of `planes` planes, row-major, and what is wanted of them.
struct Photometric {
  const float* x;  // [planes, height, width] the image that is trained
  const float* y;  // [planes, height, width] the picture
  int planes, height, width;
  bool valid;          // SSIM only where the window lies inside the image; otherwise zero padding
  double l1_weight;    // of the mean of |x-y| in the total
  double ssim_weight;  // of the mean of the SSIM map
  double offset;       // added to the total
  float* slopes;       // [3, planes, height, width] d total / d (E[x], E[x^2], E[xy]) of each window, or null
};

struct PhotometricSums {
  unsigned* blocks_done;  // 0 before `photometric`
  float2* of_block;       // [photometric_blocks] sums of |x-y| and of the SSIM map, whatever before
};
int64_t photometric_blocks(const Photometric& args);

struct PhotometricMeans {  // one number each
  float *total, *l1, *ssim;
};
void photometric(const Photometric& args, const PhotometricSums& sums, const PhotometricMeans& means,
                 cudaStream_t stream);
// grad [planes, height, width] = d total / d x, from the slopes.
void photometric_backward(const Photometric& args, float* grad, cudaStream_t stream);

struct AdamTensor {
  float* param;
  const float* grad;
  float* exp_avg;
  float* exp_avg_sq;
  int64_t count;
  float step_size;  // lr / (1 - beta1^t)
  float one_minus_beta1;
  float beta2;
  float one_minus_beta2;
  float inv_bias2;  // 1 / sqrt(1 - beta2^t)
  float eps;
  unsigned first_block;  // filled by `adam`
};

constexpr int kAdamTensors = 24;  // of one launch

void adam(AdamTensor* tensors, int count, cudaStream_t stream);

}  // namespace splatwizard::cuda
