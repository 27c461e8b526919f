// Adam of the rows that a mask marks, of many tensors in one launch; as sparse_adam.cpp computes it.
//
// A block owns kRows rows of one tensor: a thread a row looks at the mask, then all walk the rows' values, which lie in
// one run. Of four values that lie together nothing is read unless a marked row has one of them.
#include "kernels.h"

namespace splatwizard::cuda {
namespace {

constexpr int kRows = 256, kThreads = 256;

struct Batch {
  SparseAdamTensor tensors[kSparseAdamTensors];
  int count;
  const bool* mask;
  int64_t rows;
};

__device__ __forceinline__ void update(const SparseAdamTensor& a, bool marked, float& p, float g, float& m, float& v) {
  if (!marked) return;
  m = m + a.one_minus_beta1 * (g - m);
  v = a.beta2 * v + a.one_minus_beta2 * g * g;
  p -= a.lr * m / (sqrtf(v) + a.eps);
}

__global__ void __launch_bounds__(kThreads) sparse_adam_kernel(const __grid_constant__ Batch batch) {
  __shared__ bool marks[kRows];
  const int64_t first = int64_t(blockIdx.x) * kRows;
  const SparseAdamTensor& a = batch.tensors[blockIdx.y];
  const int rows = int(batch.rows - first < kRows ? batch.rows - first : kRows), row = int(threadIdx.x);
  const bool marked = row < rows && batch.mask[first + row];
  if (!__syncthreads_or(marked)) return;
  if (row < rows) marks[row] = marked;
  __syncthreads();

  const int64_t begin = first * a.width;
  const unsigned width = unsigned(a.width), values = unsigned(rows) * width;
  float* const p = a.param + begin;
  const float* const g = a.grad + begin;
  float* const m = a.exp_avg + begin;
  float* const v = a.exp_avg_sq + begin;
  for (unsigned i = 4 * threadIdx.x; i < values; i += 4 * kThreads) {
    unsigned at[4], left = i % width;
    at[0] = i / width;
#pragma unroll
    for (int k = 1; k < 4; ++k) {
      const bool next = ++left == width;
      at[k] = at[k - 1] + next;
      if (next) left = 0;
    }
    if (i + 4 <= values) {
      bool any = false;
#pragma unroll
      for (int k = 0; k < 4; ++k) any |= marks[at[k]];
      if (!any) continue;
      const float4 g4 = __ldcs(reinterpret_cast<const float4*>(g + i));
      float4 m4 = __ldcs(reinterpret_cast<const float4*>(m + i)), v4 = __ldcs(reinterpret_cast<const float4*>(v + i));
      float4 p4 = *reinterpret_cast<const float4*>(p + i);
      update(a, marks[at[0]], p4.x, g4.x, m4.x, v4.x);
      update(a, marks[at[1]], p4.y, g4.y, m4.y, v4.y);
      update(a, marks[at[2]], p4.z, g4.z, m4.z, v4.z);
      update(a, marks[at[3]], p4.w, g4.w, m4.w, v4.w);
      *reinterpret_cast<float4*>(p + i) = p4;
      __stcs(reinterpret_cast<float4*>(m + i), m4);
      __stcs(reinterpret_cast<float4*>(v + i), v4);
    } else {
#pragma unroll
      for (int k = 0; k < 4; ++k)
        if (i + k < values) update(a, marks[at[k]], p[i + k], g[i + k], m[i + k], v[i + k]);
    }
  }
}

}  // namespace

void sparse_adam(const SparseAdamTensor* tensors, int count, const bool* mask, int64_t rows, cudaStream_t stream) {
  if (count == 0 || rows == 0) return;
  Batch batch{};
  batch.count = count, batch.mask = mask, batch.rows = rows;
  for (int i = 0; i < count; ++i) batch.tensors[i] = tensors[i];
  sparse_adam_kernel<<<dim3(unsigned((rows + kRows - 1) / kRows), unsigned(count)), kThreads, 0, stream>>>(batch);
}

}  // namespace splatwizard::cuda
