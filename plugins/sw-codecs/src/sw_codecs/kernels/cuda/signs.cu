// Lookup in a grid of signs, and its gradient by the signs: a thread a place, or some places, and level. Four features,
// as published, are one load and, of floats, one atomic sum of sixteen bytes.
#include "kernels.h"

namespace sw_grid::cuda {
namespace {

using sw_sums::FloatAdder, sw_sums::WholeAdder;

constexpr int kThreads = 256, kRunThreads = 64, kRun = 8;

template <int D>
__device__ __forceinline__ void corners(const Signs& at, int64_t n, int level, int32_t* entries, float* weights) {
  float place[D];
#pragma unroll
  for (int axis = 0; axis < D; ++axis) place[axis] = at.x[n * at.columns + at.axis[axis]];
  corners_of<D, true>(at.levels.of[level], at.levels.mask, place, entries, weights);
}

template <int D, bool kFour>
__global__ void __launch_bounds__(kThreads)
    lookup_kernel(const __grid_constant__ Signs at, const float* table, float* found) {
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int level = int(blockIdx.y), features = kFour ? 4 : at.features;
  if (n >= at.count) return;
  float weights[1 << D];
  int32_t entries[1 << D];
  corners<D>(at, n, level, entries, weights);
  float sums[kFour ? 4 : kMaxFeatures] = {};
#pragma unroll
  for (int corner = 0; corner < 1 << D; ++corner) {
    const float* entry = table + int64_t(entries[corner]) * features;
    if constexpr (kFour) {
      const float4 four = *reinterpret_cast<const float4*>(entry);
      sums[0] += weights[corner] * sign_of(four.x), sums[1] += weights[corner] * sign_of(four.y);
      sums[2] += weights[corner] * sign_of(four.z), sums[3] += weights[corner] * sign_of(four.w);
    } else {
      for (int k = 0; k < features; ++k) sums[k] += weights[corner] * sign_of(entry[k]);
    }
  }
  float* to = found + n * at.row + level * features;
  if constexpr (kFour)
    *reinterpret_cast<float4*>(to) = make_float4(sums[0], sums[1], sums[2], sums[3]);
  else
    for (int k = 0; k < features; ++k) to[k] = sums[k];
}

template <class Adder>
__device__ __forceinline__ void add_four(const Adder& sums, int64_t at, const float* four) {
#pragma unroll
  for (int k = 0; k < 4; ++k) sums.add(at + k, four[k]);
}
#if __CUDA_ARCH__ >= 900
__device__ __forceinline__ void add_four(const FloatAdder& sums, int64_t at, const float* four) {
  atomicAdd(reinterpret_cast<float4*>(sums.to + at), make_float4(four[0], four[1], four[2], four[3]));
}
#endif

// Adder: FloatAdder from a table of floats, or WholeAdder from Sums.
template <int D, class Adder, class Table>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(const __grid_constant__ Signs at, const float* gradient, Table table) {
  const int64_t n = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int level = int(blockIdx.y), features = at.features;
  if (n >= at.count) return;
  const float* from = gradient + n * at.row + level * features;
  float own[kMaxFeatures];
  bool any = false;
  for (int k = 0; k < features; ++k) own[k] = from[k], any |= own[k] != 0.f;
  if (!any) return;
  float weights[1 << D];
  int32_t entries[1 << D];
  corners<D>(at, n, level, entries, weights);
  const Adder to(table);
#pragma unroll
  for (int corner = 0; corner < 1 << D; ++corner) {
    const float weight = weights[corner];
    if (weight == 0.f) continue;
    const int64_t entry = int64_t(entries[corner]) * features;
    for (int k = 0; k < features; ++k) to.add(entry + k, weight * own[k]);
  }
}

// The same of four features, for some places that follow one another: those in one cell share its sums, which makes
// fewer of them wait for the same entries.
template <int D, class Adder, class Table>
__global__ void __launch_bounds__(kRunThreads)
    backward_fours_kernel(const __grid_constant__ Signs at, const float* gradient, Table table) {
  const int64_t first = (int64_t(blockIdx.x) * kRunThreads + threadIdx.x) * kRun;
  const int64_t last = first + kRun < at.count ? first + kRun : at.count;
  const int level = int(blockIdx.y);
  constexpr int kCorners = 1 << D;
  const Adder to(table);
  float sums[kCorners][4] = {};
  int32_t held[kCorners];
#pragma unroll
  for (int corner = 0; corner < kCorners; ++corner) held[corner] = -1;
  const auto flush = [&] {
#pragma unroll
    for (int corner = 0; corner < kCorners; ++corner) {
      const float* sum = sums[corner];
      if (sum[0] != 0.f || sum[1] != 0.f || sum[2] != 0.f || sum[3] != 0.f)
        add_four(to, int64_t(held[corner]) * 4, sum);
    }
  };
  for (int64_t n = first; n < last; ++n) {
    const float4 own = *reinterpret_cast<const float4*>(gradient + n * at.row + level * 4);
    if (own.x == 0.f && own.y == 0.f && own.z == 0.f && own.w == 0.f) continue;
    float weights[kCorners];
    int32_t entries[kCorners];
    corners<D>(at, n, level, entries, weights);
    bool same = true;
#pragma unroll
    for (int corner = 0; corner < kCorners; ++corner) same &= entries[corner] == held[corner];
    if (!same) {
      flush();
#pragma unroll
      for (int corner = 0; corner < kCorners; ++corner) {
        held[corner] = entries[corner];
        sums[corner][0] = sums[corner][1] = sums[corner][2] = sums[corner][3] = 0.f;
      }
    }
#pragma unroll
    for (int corner = 0; corner < kCorners; ++corner) {
      sums[corner][0] += weights[corner] * own.x, sums[corner][1] += weights[corner] * own.y;
      sums[corner][2] += weights[corner] * own.z, sums[corner][3] += weights[corner] * own.w;
    }
  }
  flush();
}

dim3 grid_of(const Signs& at) { return {unsigned((at.count + kThreads - 1) / kThreads), unsigned(at.levels.count)}; }

template <class Adder, class Table>
void run_backward(const Signs& at, bool four, const float* gradient, Table table, cudaStream_t stream) {
  if (four) {
    const int64_t runs = (at.count + kRun - 1) / kRun;
    const dim3 blocks(unsigned((runs + kRunThreads - 1) / kRunThreads), unsigned(at.levels.count));
    const auto kernel = at.axes == 2 ? backward_fours_kernel<2, Adder, Table> : backward_fours_kernel<3, Adder, Table>;
    kernel<<<blocks, kRunThreads, 0, stream>>>(at, gradient, table);
  } else {
    const auto kernel = at.axes == 2 ? backward_kernel<2, Adder, Table> : backward_kernel<3, Adder, Table>;
    kernel<<<grid_of(at), kThreads, 0, stream>>>(at, gradient, table);
  }
}

}  // namespace

void signs_lookup(const Signs& at, bool four, const float* table, float* found, cudaStream_t stream) {
  const auto kernel = at.axes == 2 ? (four ? lookup_kernel<2, true> : lookup_kernel<2, false>)
                                   : (four ? lookup_kernel<3, true> : lookup_kernel<3, false>);
  kernel<<<grid_of(at), kThreads, 0, stream>>>(at, table, found);
}

void signs_backward(const Signs& at, bool four, const float* gradient, float* table, cudaStream_t stream) {
  run_backward<FloatAdder>(at, four, gradient, table, stream);
}

void signs_backward(const Signs& at, bool four, const float* gradient, const sw_sums::Sums& sums, cudaStream_t stream) {
  run_backward<WholeAdder>(at, four, gradient, sums, stream);
}

}  // namespace sw_grid::cuda
