// One dense Adam step of many tensors in one launch, as torch.optim.Adam computes it:
//   m += (1 - b1)(g - m)     v = b2 v + (1 - b2) g^2     p -= lr/(1 - b1^t) m / (sqrt(v)/sqrt(1 - b2^t) + eps)
// 28 bytes of traffic for each parameter: the memory's speed is the limit. Where g, m and v are all zero nothing would
// change, and only these are read (12 bytes): the spherical-harmonics bands that are not yet trained.
#include "kernels.h"

namespace splatwizard::cuda {
namespace {

constexpr int kThreads = 256, kVectors = 2, kPerBlock = kThreads * kVectors * 4;

struct Batch {
  AdamTensor tensors[kAdamTensors];
  int count;
};

__device__ __forceinline__ bool is_zero(float4 a) {  // bit patterns: -0.0 and NaN count as not zero
  return (__float_as_uint(a.x) | __float_as_uint(a.y) | __float_as_uint(a.z) | __float_as_uint(a.w)) == 0;
}

__device__ __forceinline__ void update(const AdamTensor& t, float& p, float g, float& m, float& v) {
  m = m + t.one_minus_beta1 * (g - m);
  v = t.beta2 * v + t.one_minus_beta2 * g * g;
  p -= t.step_size * m / (sqrtf(v) * t.inv_bias2 + t.eps);
}

__global__ void __launch_bounds__(kThreads) adam_kernel(const __grid_constant__ Batch batch) {
  int index = 0;
  while (index + 1 < batch.count && batch.tensors[index + 1].first_block <= blockIdx.x) ++index;
  const AdamTensor& t = batch.tensors[index];
  const int64_t begin = int64_t(blockIdx.x - t.first_block) * kPerBlock;
  if (begin + kPerBlock <= t.count) {
    auto* p4 = reinterpret_cast<float4*>(t.param + begin);
    const auto* g4 = reinterpret_cast<const float4*>(t.grad + begin);
    auto* m4 = reinterpret_cast<float4*>(t.exp_avg + begin);
    auto* v4 = reinterpret_cast<float4*>(t.exp_avg_sq + begin);
    float4 g[kVectors], m[kVectors], v[kVectors], p[kVectors];
    bool rests[kVectors];
#pragma unroll
    for (int k = 0; k < kVectors; ++k) {
      const int i = int(threadIdx.x) + k * kThreads;
      g[k] = __ldcs(g4 + i), m[k] = __ldcs(m4 + i), v[k] = __ldcs(v4 + i);
    }
#pragma unroll
    for (int k = 0; k < kVectors; ++k) {
      rests[k] = t.eps > 0.f && is_zero(g[k]) && is_zero(m[k]) && is_zero(v[k]);
      if (!rests[k]) p[k] = p4[threadIdx.x + k * kThreads];
    }
#pragma unroll
    for (int k = 0; k < kVectors; ++k) {
      if (rests[k]) continue;
      update(t, p[k].x, g[k].x, m[k].x, v[k].x);
      update(t, p[k].y, g[k].y, m[k].y, v[k].y);
      update(t, p[k].z, g[k].z, m[k].z, v[k].z);
      update(t, p[k].w, g[k].w, m[k].w, v[k].w);
      const int i = int(threadIdx.x) + k * kThreads;
      p4[i] = p[k];
      __stcs(m4 + i, m[k]);
      __stcs(v4 + i, v[k]);
    }
  } else {
    for (int64_t i = begin + threadIdx.x; i < t.count; i += kThreads)
      update(t, t.param[i], t.grad[i], t.exp_avg[i], t.exp_avg_sq[i]);
  }
}

}  // namespace

void adam(AdamTensor* tensors, int count, cudaStream_t stream) {
  Batch batch{};
  unsigned blocks = 0;
  batch.count = count;
  for (int i = 0; i < count; ++i) {
    batch.tensors[i] = tensors[i];
    batch.tensors[i].first_block = blocks;
    blocks += unsigned((tensors[i].count + kPerBlock - 1) / kPerBlock);
  }
  if (blocks > 0) adam_kernel<<<blocks, kThreads, 0, stream>>>(batch);
}

}  // namespace splatwizard::cuda
