// What the CUDA kernels share: warp and block primitives.
#pragma once

#include <cstdint>

#include "../common.h"

namespace sw::cuda {

constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kWarp = 32;

__device__ __forceinline__ int lane_index() { return int(threadIdx.x) & (kWarp - 1); }
__device__ __forceinline__ int warp_index() { return int(threadIdx.x) / kWarp; }

__device__ __forceinline__ unsigned warp_sum(unsigned value) {
#if __CUDA_ARCH__ >= 800
  return __reduce_add_sync(kAllLanes, value);
#else
  for (int step = kWarp / 2; step > 0; step /= 2) value += __shfl_xor_sync(kAllLanes, value, step);
  return value;
#endif
}

__device__ __forceinline__ unsigned warp_max(unsigned value) {
#if __CUDA_ARCH__ >= 800
  return __reduce_max_sync(kAllLanes, value);
#else
  for (int step = kWarp / 2; step > 0; step /= 2) value = max(value, __shfl_xor_sync(kAllLanes, value, step));
  return value;
#endif
}

// Sum over the lanes below this one.
__device__ __forceinline__ unsigned warp_prefix(unsigned value) {
  unsigned sum = value;
  for (int step = 1; step < kWarp; step *= 2) {
    const unsigned below = __shfl_up_sync(kAllLanes, sum, step);
    if (lane_index() >= step) sum += below;
  }
  return sum - value;
}

// Sum over the threads of the block below this one; `total` receives the block's. For blocks of up to 1024 threads;
// `scratch` is shared memory for 33 values and may be used again after the next __syncthreads.
__device__ __forceinline__ unsigned block_prefix(unsigned value, unsigned* scratch, unsigned* total) {
  const unsigned in_warp = warp_prefix(value);
  if (lane_index() == kWarp - 1) scratch[warp_index()] = in_warp + value;
  __syncthreads();
  if (warp_index() == 0) {
    const int warps = int(blockDim.x) / kWarp;
    const unsigned sum = lane_index() < warps ? scratch[lane_index()] : 0;
    const unsigned before = warp_prefix(sum);
    if (lane_index() < warps) scratch[lane_index()] = before;
    if (lane_index() == kWarp - 1) scratch[kWarp] = before + sum;
  }
  __syncthreads();
  *total = scratch[kWarp];
  return scratch[warp_index()] + in_warp;
}

// Prefix sums over the blocks of a grid in one pass ("decoupled look-back", Merrill & Garland 2016). A block publishes
// its own sum, then its prefix, each in one 64-bit word together with a flag; blocks take their numbers from a ticket,
// so those before a block are always running or done. `states`, one word a block, starts as zeros.
constexpr uint64_t kSumReady = uint64_t(1) << 32, kPrefixReady = uint64_t(2) << 32;

__device__ __forceinline__ uint64_t load_state(const uint64_t* state) {
  return *reinterpret_cast<const volatile uint64_t*>(state);
}
__device__ __forceinline__ void store_state(uint64_t* state, uint64_t value) {
  *reinterpret_cast<volatile uint64_t*>(state) = value;
}

// By all lanes of one warp: the sum over the blocks before `block`. Hundreds of blocks run at once and all look back as
// far as the oldest of them, so a warp asks for kAhead windows of 32 blocks together: one wait instead of many.
__device__ __forceinline__ unsigned look_back(uint64_t* states, int block, unsigned sum) {
  constexpr int kAhead = 8;
  if (lane_index() == 0) store_state(states + block, (block == 0 ? kPrefixReady : kSumReady) | sum);
  unsigned before = 0;
  bool found = false;
  for (int from = block - 1; from >= 0 && !found; from -= kAhead * kWarp) {
    uint64_t state[kAhead];
    const auto load = [&](int window) {
      const int i = from - window * kWarp - lane_index();
      state[window] = i >= 0 ? load_state(states + i) : kPrefixReady;
    };
#pragma unroll
    for (int window = 0; window < kAhead; ++window) load(window);
#pragma unroll
    for (int window = 0; window < kAhead; ++window) {
      if (found) break;
      while (__any_sync(kAllLanes, (state[window] >> 32) == 0)) load(window);
      const unsigned with_prefix = __ballot_sync(kAllLanes, (state[window] >> 32) == 2);
      const int last = with_prefix != 0 ? __ffs(int(with_prefix)) - 1 : kWarp - 1;
      before += warp_sum(lane_index() <= last ? unsigned(state[window]) : 0u);
      found = with_prefix != 0;
    }
  }
  if (lane_index() == 0 && block > 0) store_state(states + block, kPrefixReady | (before + sum));
  return before;
}

// One float, from global into shared memory, without a register in between; wait with `async_wait`.
__device__ __forceinline__ void async_copy(float* shared, const float* global) {
#if __CUDA_ARCH__ >= 800
  asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(unsigned(__cvta_generic_to_shared(shared))),
               "l"(global));
#else
  *shared = *global;
#endif
}
__device__ __forceinline__ void async_wait() {
#if __CUDA_ARCH__ >= 800
  asm volatile("cp.async.wait_all;" ::: "memory");
#endif
}

// 2^x, relative error 2^-22.
__device__ __forceinline__ float exp_2(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}

constexpr int64_t ceil_div(int64_t a, int64_t b) { return (a + b - 1) / b; }

}  // namespace sw::cuda
