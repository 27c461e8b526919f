// Lookup in a grid of real numbers, and its gradient: a thread a place and level, blocks of one level next to one
// another, so that the table of a level is read while the cache has it. Nothing is kept for the backward pass.
#include "kernels.h"

namespace sw_grid::cuda {
namespace {

using sw_sums::FloatAdder, sw_sums::WholeAdder;

constexpr int kThreads = 256;

template <int D>
__device__ __forceinline__ void load_place(const float* x, int64_t n, float* place) {
#pragma unroll
  for (int axis = 0; axis < D; ++axis) place[axis] = x[D * n + axis];
}

template <int D, int F>
__global__ void __launch_bounds__(kThreads)
    lookup_kernel(const __grid_constant__ Levels levels, int features, int64_t n, const float* x, const float* table,
                  float* found) {
  const int64_t point = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int level = int(blockIdx.y), count = F > 0 ? F : features;
  if (point >= n) return;
  float place[D], weights[1 << D];
  int32_t entries[1 << D];
  load_place<D>(x, point, place);
  corners_of<D>(levels.of[level], levels.mask, place, entries, weights);
  float sums[F > 0 ? F : kMaxFeatures] = {};
#pragma unroll
  for (int corner = 0; corner < 1 << D; ++corner) {
    const float* entry = table + int64_t(entries[corner]) * count;
    if constexpr (F == 2) {  // one load of eight bytes
      const float2 pair = *reinterpret_cast<const float2*>(entry);
      sums[0] += weights[corner] * pair.x, sums[1] += weights[corner] * pair.y;
    } else {
      for (int k = 0; k < count; ++k) sums[k] += weights[corner] * entry[k];
    }
  }
  float* to = found + (point * levels.count + level) * count;
  if constexpr (F == 2)
    *reinterpret_cast<float2*>(to) = make_float2(sums[0], sums[1]);
  else
    for (int k = 0; k < count; ++k) to[k] = sums[k];
}

__device__ __forceinline__ void add_pair(const FloatAdder& sums, int64_t at, float a, float b) {
#if __CUDA_ARCH__ >= 900
  atomicAdd(reinterpret_cast<float2*>(sums.to + at), make_float2(a, b));
#else
  sums.add(at, a), sums.add(at + 1, b);
#endif
}
__device__ __forceinline__ void add_pair(const WholeAdder& sums, int64_t at, float a, float b) {
  sums.add(at, a), sums.add(at + 1, b);
}

// Adder: FloatAdder from a table of floats, or WholeAdder from Sums.
template <int D, int F, class Adder, class Table>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(const __grid_constant__ Levels levels, int features, int64_t n, const float* x,
                    const float* gradient, Table table) {
  const int64_t point = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  const int level = int(blockIdx.y), count = F > 0 ? F : features;
  if (point >= n) return;
  const float* from = gradient + (point * levels.count + level) * count;
  float own[F > 0 ? F : kMaxFeatures];
  bool any = false;
  for (int k = 0; k < count; ++k) own[k] = from[k], any |= own[k] != 0.f;
  if (!any) return;
  float place[D], weights[1 << D];
  int32_t entries[1 << D];
  load_place<D>(x, point, place);
  corners_of<D>(levels.of[level], levels.mask, place, entries, weights);
  const Adder sums(table);
#pragma unroll
  for (int corner = 0; corner < 1 << D; ++corner) {
    const int64_t entry = int64_t(entries[corner]) * count;
    if constexpr (F == 2)
      add_pair(sums, entry, weights[corner] * own[0], weights[corner] * own[1]);
    else
      for (int k = 0; k < count; ++k) sums.add(entry + k, weights[corner] * own[k]);
  }
}

__global__ void __launch_bounds__(kThreads)
    add_sums_kernel(const __grid_constant__ sw_sums::Sums sums, int64_t n, float* to) {
  const int64_t i = int64_t(blockIdx.x) * kThreads + threadIdx.x;
  if (i < n) to[i] += sw_sums::value_of(sums.to[i], *sums.largest, sums.count);
}

dim3 grid_of(int64_t n, int levels) { return {unsigned((n + kThreads - 1) / kThreads), unsigned(levels)}; }

template <class Adder, class Table>
void run_backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
                  Table table, cudaStream_t stream) {
  const auto kernel =
      axes == 2 ? (features == 2 ? backward_kernel<2, 2, Adder, Table> : backward_kernel<2, 0, Adder, Table>)
                : (features == 2 ? backward_kernel<3, 2, Adder, Table> : backward_kernel<3, 0, Adder, Table>);
  kernel<<<grid_of(n, levels.count), kThreads, 0, stream>>>(levels, features, n, x, gradient, table);
}

}  // namespace

void lookup(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* table, float* found,
            cudaStream_t stream) {
  const auto kernel = axes == 2 ? (features == 2 ? lookup_kernel<2, 2> : lookup_kernel<2, 0>)
                                : (features == 2 ? lookup_kernel<3, 2> : lookup_kernel<3, 0>);
  kernel<<<grid_of(n, levels.count), kThreads, 0, stream>>>(levels, features, n, x, table, found);
}

void backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
              float* table, cudaStream_t stream) {
  run_backward<FloatAdder>(levels, axes, features, n, x, gradient, table, stream);
}

void backward(const Levels& levels, int axes, int features, int64_t n, const float* x, const float* gradient,
              const sw_sums::Sums& sums, cudaStream_t stream) {
  run_backward<WholeAdder>(levels, axes, features, n, x, gradient, sums, stream);
}

void add_sums(const sw_sums::Sums& sums, int64_t n, float* to, cudaStream_t stream) {
  if (n > 0) add_sums_kernel<<<unsigned((n + kThreads - 1) / kThreads), kThreads, 0, stream>>>(sums, n, to);
}

}  // namespace sw_grid::cuda
