// Lookup in triplanes and its gradient: a thread takes four channels (or one) of a pair of axes.
#include <type_traits>

#include "triplane.h"

namespace sw_triplane::cuda {
namespace {

using sw_sums::FloatAdder, sw_sums::WholeAdder;

constexpr int kThreads = 128, kRun = 8;
constexpr int kTile = 32, kRows = 8;

struct FromFloats {
  const float* from;
  __device__ __forceinline__ float operator()(int64_t at) const { return from[at]; }
};
struct FromSums {
  sw_sums::Sums sums;
  __device__ __forceinline__ float operator()(int64_t at) const {
    return sw_sums::value_of(sums.to[at], *sums.largest, sums.count);
  }
};

template <class From>
__global__ void __launch_bounds__(kTile* kRows)
    transpose_kernel(const __grid_constant__ From from, float* to, int64_t a, int64_t b, float gain) {
  __shared__ float tile[kTile][kTile + 1];
  const int64_t plane = int64_t(blockIdx.z) * a * b, column = int64_t(blockIdx.x) * kTile;
  const int64_t row = int64_t(blockIdx.y) * kTile;
  const int x = int(threadIdx.x), y = int(threadIdx.y);
  for (int i = y; i < kTile; i += kRows)
    if (row + i < a && column + x < b) tile[i][x] = from(plane + (row + i) * b + column + x);
  __syncthreads();
  for (int i = y; i < kTile; i += kRows)
    if (column + i < b && row + x < a) {
      const float value = tile[x][i];
      to[plane + (column + i) * a + row + x] = gain > 0.f ? rintf(value * gain) / gain : value;
    }
}

template <int kWidth>
struct Some {
  float at[kWidth];
};

template <int kWidth>
__device__ __forceinline__ Some<kWidth> load(const float* from) {
  Some<kWidth> found;
  if constexpr (kWidth == 4) {
    const float4 four = *reinterpret_cast<const float4*>(from);
    found.at[0] = four.x, found.at[1] = four.y, found.at[2] = four.z, found.at[3] = four.w;
  } else {
    found.at[0] = *from;
  }
  return found;
}

template <int kWidth, class Adder>
__device__ __forceinline__ void add(const Adder& sums, int64_t at, const Some<kWidth>& some) {
#if __CUDA_ARCH__ >= 900
  if constexpr (kWidth == 4 && std::is_same_v<Adder, FloatAdder>) {
    atomicAdd(reinterpret_cast<float4*>(sums.to + at),
              make_float4(some.at[0], some.at[1], some.at[2], some.at[3]));
  } else
#endif
  {
#pragma unroll
    for (int i = 0; i < kWidth; ++i) sums.add(at + i, some.at[i]);
  }
}

__device__ __forceinline__ FloatAdder adder_of(const Tables& tables, int scale) {
  return FloatAdder(tables.of[scale]);
}
__device__ __forceinline__ WholeAdder adder_of(const SumTables& tables, int scale) {
  return WholeAdder({tables.of[scale], tables.largest, tables.count});
}

// Thread number -> what it takes: a site or run of sites, a pair, the first of its channels.
struct Part {
  int64_t row;
  int pair, channel;
};

template <int kWidth>
__device__ __forceinline__ Part part_of(const Sites& sites) {
  const int each = sites.channels / kWidth;
  const int64_t thread = int64_t(blockIdx.x) * kThreads + threadIdx.x, row = thread / (kPairs * each);
  const int rest = int(thread - row * kPairs * each);
  return {row, rest / each, rest % each * kWidth};
}

template <int kWidth>
__global__ void __launch_bounds__(kThreads)
    lookup_kernel(const __grid_constant__ Sites sites, const __grid_constant__ Tables tables, float* features) {
  const Part part = part_of<kWidth>(sites);
  if (part.row >= sites.count) return;
  Some<kWidth> sum{};
  for (int scale = 0; scale < sites.scales; ++scale) {
    const int64_t site = ((part.row * sites.scales + scale) * kPairs + part.pair) * kCorners;
#pragma unroll
    for (int corner = 0; corner < kCorners; ++corner) {
      const int64_t cell = sites.cells[site + corner];
      const float weight = sites.weights[site + corner];
      const Some<kWidth> value = load<kWidth>(tables.of[scale] + cell * sites.channels + part.channel);
#pragma unroll
      for (int i = 0; i < kWidth; ++i) sum.at[i] += weight * value.at[i];
    }
    float* to = features + ((part.row * sites.scales + scale) * kPairs + part.pair) * sites.channels + part.channel;
    if constexpr (kWidth == 4)
      *reinterpret_cast<float4*>(to) = make_float4(sum.at[0], sum.at[1], sum.at[2], sum.at[3]);
    else
      *to = sum.at[0];
  }
}

template <int kWidth>
__device__ __forceinline__ bool any(const Some<kWidth>& some) {
  bool found = false;
#pragma unroll
  for (int i = 0; i < kWidth; ++i) found |= some.at[i] != 0.f;
  return found;
}

// To: Tables or SumTables.
template <int kWidth, class To>
__global__ void __launch_bounds__(kThreads)
    backward_kernel(const __grid_constant__ Sites sites, const float* slopes, const __grid_constant__ To tables) {
  const Part part = part_of<kWidth>(sites);
  const int64_t first = part.row * kRun, last = first + kRun < sites.count ? first + kRun : sites.count;
  for (int scale = 0; scale < sites.scales; ++scale) {
    const auto to = adder_of(tables, scale);
    Some<kWidth> sums[kCorners] = {};
    int32_t cells[kCorners] = {-1, -1, -1, -1};
    const auto flush = [&] {
#pragma unroll
      for (int corner = 0; corner < kCorners; ++corner)
        if (cells[corner] >= 0 && any<kWidth>(sums[corner]))
          add<kWidth>(to, int64_t(cells[corner]) * sites.channels + part.channel, sums[corner]);
    };
    for (int64_t row = first; row < last; ++row) {
      // A plane is in the feature of its own scale and of all finer ones.
      Some<kWidth> slope{};
      for (int other = scale; other < sites.scales; ++other) {
        const Some<kWidth> one = load<kWidth>(
            slopes + ((row * sites.scales + other) * kPairs + part.pair) * sites.channels + part.channel);
#pragma unroll
        for (int i = 0; i < kWidth; ++i) slope.at[i] += one.at[i];
      }
      if (!any<kWidth>(slope)) continue;
      const int64_t site = ((row * sites.scales + scale) * kPairs + part.pair) * kCorners;
      // The first and the last corner tell a cell, also on the border, where corners fall together.
      if (sites.cells[site] != cells[0] || sites.cells[site + kCorners - 1] != cells[kCorners - 1]) {
        flush();
#pragma unroll
        for (int corner = 0; corner < kCorners; ++corner)
          cells[corner] = sites.cells[site + corner], sums[corner] = Some<kWidth>{};
      }
#pragma unroll
      for (int corner = 0; corner < kCorners; ++corner) {
        const float weight = sites.weights[site + corner];
#pragma unroll
        for (int i = 0; i < kWidth; ++i) sums[corner].at[i] += weight * slope.at[i];
      }
    }
    flush();
  }
}

unsigned blocks_of(int64_t rows, const Sites& sites, int width) {
  return unsigned((rows * kPairs * (sites.channels / width) + kThreads - 1) / kThreads);
}

template <class From>
void run_transpose(const From& from, float* to, int k, int64_t a, int64_t b, float gain, cudaStream_t stream) {
  if (k == 0 || a == 0 || b == 0) return;
  const dim3 blocks(unsigned((b + kTile - 1) / kTile), unsigned((a + kTile - 1) / kTile), unsigned(k));
  transpose_kernel<From><<<blocks, dim3(kTile, kRows), 0, stream>>>(from, to, a, b, gain);
}

template <class To>
void run_backward(const Sites& sites, bool four, const float* slopes, const To& tables, cudaStream_t stream) {
  const int64_t runs = (sites.count + kRun - 1) / kRun;
  if (runs == 0) return;
  if (four)
    backward_kernel<4, To><<<blocks_of(runs, sites, 4), kThreads, 0, stream>>>(sites, slopes, tables);
  else
    backward_kernel<1, To><<<blocks_of(runs, sites, 1), kThreads, 0, stream>>>(sites, slopes, tables);
}

}  // namespace

void transpose(const float* from, float* to, int k, int64_t a, int64_t b, float gain, cudaStream_t stream) {
  run_transpose(FromFloats{from}, to, k, a, b, gain, stream);
}

void transpose(const sw_sums::Sums& from, float* to, int k, int64_t a, int64_t b, cudaStream_t stream) {
  run_transpose(FromSums{from}, to, k, a, b, 0.f, stream);
}

void lookup(const Sites& sites, bool four, const Tables& tables, float* features, cudaStream_t stream) {
  if (sites.count == 0) return;
  if (four)
    lookup_kernel<4><<<blocks_of(sites.count, sites, 4), kThreads, 0, stream>>>(sites, tables, features);
  else
    lookup_kernel<1><<<blocks_of(sites.count, sites, 1), kThreads, 0, stream>>>(sites, tables, features);
}

void backward(const Sites& sites, bool four, const float* slopes, const Tables& tables, cudaStream_t stream) {
  run_backward(sites, four, slopes, tables, stream);
}

void backward(const Sites& sites, bool four, const float* slopes, const SumTables& tables, cudaStream_t stream) {
  run_backward(sites, four, slopes, tables, stream);
}

}  // namespace sw_triplane::cuda
