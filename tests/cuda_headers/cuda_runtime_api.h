// CUDA on a CPU, as far as kernels of this workspace need it, for tests without a GPU (tests/cuda_on_cpu.py): a block's
// threads are fibers of the caller's thread, which change at barriers and where warps exchange values; blocks follow one
// another. Shared memory holds NaN before, threads go in either direction by turns, and a wait that never ends aborts.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <map>
#include <type_traits>
#include <utility>
#include <vector>

#define __global__
#define __device__
#define __host__
#define __shared__ static
#define __constant__ static
#define __forceinline__ inline __attribute__((always_inline))
#define __noinline__ __attribute__((noinline))
#define __launch_bounds__(...)
#define __grid_constant__
#define __align__(bytes) __attribute__((aligned(bytes)))

struct uint3 {
  unsigned x, y, z;
};
struct dim3 : uint3 {
  constexpr dim3(unsigned x = 1, unsigned y = 1, unsigned z = 1) : uint3{x, y, z} {}
};
#define SW_VECTOR(type, name)                                                            \
  struct alignas(2 * sizeof(type)) name##2 { type x, y; };                               \
  struct name##3 { type x, y, z; };                                                      \
  struct alignas(4 * sizeof(type)) name##4 { type x, y, z, w; };                         \
  inline name##2 make_##name##2(type x, type y) { return {x, y}; }                       \
  inline name##3 make_##name##3(type x, type y, type z) { return {x, y, z}; }            \
  inline name##4 make_##name##4(type x, type y, type z, type w) { return {x, y, z, w}; }
SW_VECTOR(float, float)
SW_VECTOR(int, int)
#undef SW_VECTOR
struct alignas(8) uint2 {
  unsigned x, y;
};
struct alignas(16) uint4 {
  unsigned x, y, z, w;
};
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }

enum cudaError_t { cudaSuccess, cudaErrorInvalidValue = 1, cudaErrorInvalidConfiguration = 9, cudaErrorInvalidHandle = 400 };
using cudaStream_t = struct CUstream_st*;
enum cudaDeviceAttr { cudaDevAttrMultiProcessorCount };
enum cudaFuncAttribute { cudaFuncAttributeMaxDynamicSharedMemorySize };

inline uint3 threadIdx, blockIdx;
inline dim3 blockDim, gridDim;
constexpr int warpSize = 32;

namespace cuda_on_cpu {

constexpr unsigned kProcessors = 2, kMostThreads = 1024, kWarp = 32;
constexpr size_t kStack = 256 << 10, kMostShared = 227 << 10, kAskedShared = 48 << 10;

enum class Wait { none, warp, block };

struct Fiber {
  ucontext_t start;
  jmp_buf at;
  std::vector<char> stack;
  bool ended = true;
  Wait wait = Wait::none;
  unsigned mask = 0;
  int64_t warp_arrivals = 0, block_arrivals = 0;
  uint3 place;
  unsigned number = 0;
};

struct State {
  cudaError_t error = cudaSuccess;
  int device = 0;
  std::map<const void*, size_t> asked;
  std::vector<Fiber*> fibers;
  Fiber* current = nullptr;
  unsigned count = 0;  // threads of a block
  jmp_buf scheduler;
  std::function<void()> body;
  alignas(128) char shared[kMostShared];
  char exchanged[2][kMostThreads][64];  // by turns: a thread is ahead of others by one exchange at most
  int votes[2][kMostThreads];
};
inline State state;

inline void give_way(Wait wait, unsigned mask = 0) {
  Fiber& own = *state.current;
  own.wait = wait, own.mask = mask;
  if (_setjmp(own.at) == 0) _longjmp(state.scheduler, 1);
}

inline void live() {
  for (;;) {
    state.body();
    state.current->ended = true;
    give_way(Wait::none);
  }
}

inline __attribute__((noinline)) void resume(Fiber& fiber) {
  state.current = &fiber, threadIdx = fiber.place, fiber.wait = Wait::none;
  if (_setjmp(state.scheduler) != 0) return;
  if (!fiber.stack.empty()) _longjmp(fiber.at, 1);
  fiber.stack.resize(kStack);
  getcontext(&fiber.start);
  fiber.start.uc_stack.ss_sp = fiber.stack.data(), fiber.start.uc_stack.ss_size = kStack;
  makecontext(&fiber.start, live, 0);
  setcontext(&fiber.start);
}

inline bool may_go_on(const Fiber& fiber) {
  const bool warp = fiber.wait == Wait::warp;
  if (fiber.wait == Wait::none) return true;
  const unsigned first = warp ? fiber.number / kWarp * kWarp : 0, last = warp ? first + kWarp : state.count;
  for (unsigned i = first; i < last && i < state.count; ++i) {
    const Fiber& other = *state.fibers[i];
    if (other.ended || (warp && !(fiber.mask >> (i - first) & 1))) continue;
    if (warp ? other.warp_arrivals < fiber.warp_arrivals : other.block_arrivals < fiber.block_arrivals) return false;
  }
  return true;
}

inline void run_block() {
  for (unsigned i = 0; i < state.count; ++i) {
    if (i == state.fibers.size()) state.fibers.push_back(new Fiber);
    Fiber& fiber = *state.fibers[i];
    fiber.ended = false, fiber.wait = Wait::none, fiber.warp_arrivals = fiber.block_arrivals = 0, fiber.number = i;
    fiber.place = {i % blockDim.x, i / blockDim.x % blockDim.y, i / blockDim.x / blockDim.y};
  }
  unsigned left = state.count;
  for (bool back = false; left > 0; back = !back) {
    bool any = false;
    for (unsigned i = 0; i < state.count; ++i) {
      Fiber& fiber = *state.fibers[back ? state.count - 1 - i : i];
      if (fiber.ended || !may_go_on(fiber)) continue;
      resume(fiber);
      any = true, left -= fiber.ended;
    }
    if (!any) std::fprintf(stderr, "threads wait for one another for ever\n"), std::abort();
  }
}

template <class... Parameters>
auto launch(void (*kernel)(Parameters...), dim3 grid, dim3 block, size_t shared = 0, cudaStream_t stream = nullptr) {
  return [=](Parameters... given) {
    const auto asked = state.asked.find(reinterpret_cast<const void*>(kernel));
    const size_t room = asked == state.asked.end() ? kAskedShared : asked->second;
    const unsigned threads = block.x * block.y * block.z;
    if (grid.x == 0 || grid.y == 0 || grid.z == 0 || grid.x > 0x7fffffff || grid.y > 65535 || grid.z > 65535 ||
        threads == 0 || threads > kMostThreads)
      state.error = cudaErrorInvalidConfiguration;
    else if (shared > room || shared > kMostShared)
      state.error = cudaErrorInvalidValue;
    else if (stream == nullptr)  // torch hands one over
      state.error = cudaErrorInvalidHandle;
    else {
      gridDim = grid, blockDim = block, state.count = threads;
      state.body = [&] { kernel(given...); };
      for (unsigned z = 0; z < grid.z; ++z)
        for (unsigned y = 0; y < grid.y; ++y)
          for (unsigned x = 0; x < grid.x; ++x) {
            std::memset(state.shared, 0xff, shared);
            blockIdx = {x, y, z};
            run_block();
          }
    }
  };
}

template <class Value>
struct Lanes {
  const char (*at)[64];
  Value operator[](unsigned lane) const {
    Value found;
    std::memcpy(&found, at[lane], sizeof(Value));
    return found;
  }
};

// Waits for the warp, and returns what its lanes brought.
template <class Value>
Lanes<Value> of_warp(unsigned mask, const Value& own) {
  static_assert(sizeof(Value) <= 64);
  Fiber& fiber = *state.current;
  const auto& room = state.exchanged[fiber.warp_arrivals++ % 2];
  std::memcpy(const_cast<char*>(room[fiber.number]), &own, sizeof(Value));
  give_way(Wait::warp, mask);
  return {room + fiber.number / kWarp * kWarp};
}

inline unsigned lane() { return state.current->number % kWarp; }

// Waits for the block, and returns the sum of what its threads brought.
inline int of_block(int own) {
  Fiber& fiber = *state.current;
  int* const votes = state.votes[fiber.block_arrivals++ % 2];
  votes[fiber.number] = own;
  give_way(Wait::block);
  int sum = 0;
  for (unsigned i = 0; i < state.count; ++i) sum += state.fibers[i]->ended ? 0 : votes[i];
  return sum;
}

template <class To, class From>
To bits_as(From from) {
  static_assert(sizeof(To) == sizeof(From));
  To to;
  std::memcpy(&to, &from, sizeof(to));
  return to;
}

}  // namespace cuda_on_cpu

inline cudaError_t cudaGetLastError() { return std::exchange(cuda_on_cpu::state.error, cudaSuccess); }
inline const char* cudaGetErrorString(cudaError_t error) {
  return error == cudaErrorInvalidConfiguration ? "invalid configuration argument"
         : error == cudaErrorInvalidHandle      ? "invalid stream"
                                                : "invalid argument";
}
inline cudaError_t cudaGetDevice(int* device) { return *device = cuda_on_cpu::state.device, cudaSuccess; }
inline cudaError_t cudaSetDevice(int device) { return cuda_on_cpu::state.device = device, cudaSuccess; }
inline cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr, int) {
  return *value = int(cuda_on_cpu::kProcessors), cudaSuccess;
}
inline cudaError_t cudaMemsetAsync(void* at, int value, size_t bytes, cudaStream_t) {
  return std::memset(at, value, bytes), cudaSuccess;
}
template <class Kernel>
cudaError_t cudaFuncSetAttribute(Kernel* kernel, cudaFuncAttribute, int value) {
  return cuda_on_cpu::state.asked[reinterpret_cast<const void*>(kernel)] = size_t(value), cudaSuccess;
}

#ifdef __CUDACC__

inline void __threadfence() {}  // blocks run one after the other
template <class Value>
Value __ldcg(const Value* place) {
  return *place;
}
template <class Value>
Value __ldcs(const Value* place) {
  return *place;
}
template <class Value>
void __stcs(Value* place, Value value) {
  *place = value;
}
inline void __syncthreads() { cuda_on_cpu::of_block(0); }
inline int __syncthreads_count(int own) { return cuda_on_cpu::of_block(own != 0); }
inline int __syncthreads_or(int own) { return cuda_on_cpu::of_block(own != 0) != 0; }
inline int __syncthreads_and(int own) { return cuda_on_cpu::of_block(own == 0) == 0; }
inline void __syncwarp(unsigned mask = ~0u) { cuda_on_cpu::of_warp(mask, 0); }
template <class Value>
Value __shfl_sync(unsigned mask, Value own, int lane) {
  return cuda_on_cpu::of_warp(mask, own)[unsigned(lane) % 32];
}
template <class Value>
Value __shfl_xor_sync(unsigned mask, Value own, int apart) {
  return cuda_on_cpu::of_warp(mask, own)[cuda_on_cpu::lane() ^ unsigned(apart)];
}

template <class Value>
Value atomicAdd(Value* place, std::type_identity_t<Value> value) {
  const Value before = *place;
  return *place = Value(before + value), before;
}
inline float2 atomicAdd(float2* place, float2 value) {
  const float2 before = *place;
  return *place = {before.x + value.x, before.y + value.y}, before;
}
inline float4 atomicAdd(float4* place, float4 value) {
  const float4 b = *place;
  return *place = {b.x + value.x, b.y + value.y, b.z + value.z, b.w + value.w}, b;
}

inline float __uint_as_float(unsigned bits) { return cuda_on_cpu::bits_as<float>(bits); }
inline float __int_as_float(int bits) { return cuda_on_cpu::bits_as<float>(bits); }
inline unsigned __float_as_uint(float number) { return cuda_on_cpu::bits_as<unsigned>(number); }
inline int __float_as_int(float number) { return cuda_on_cpu::bits_as<int>(number); }
inline float __fmul_rn(float a, float b) { return a * b; }
inline long long __float2ll_rn(float number) { return std::llrint(number); }
inline float __ll2float_rn(long long number) { return float(number); }
inline size_t __cvta_generic_to_shared(const void* at) { return size_t(static_cast<const char*>(at) - cuda_on_cpu::state.shared); }

namespace cuda_on_cpu {

// Inline assembly, by name, as tests/cuda_on_cpu.py writes it: d += a b of 16 x k by k x 8 numbers. Of lane l, with
// r = l / 4 and q = l % 4: d has row r, columns 2 q and 2 q + 1, then row r + 8.
template <int kDepth, class Factors, class Left, class Right>
void multiply(float& d0, float& d1, float& d2, float& d3, const Factors& own, const Left& left, const Right& right) {
  const Lanes<Factors> all = of_warp(~0u, own);
  float* const d[4] = {&d0, &d1, &d2, &d3};
  for (int i = 0; i < 4; ++i) {
    double sum = *d[i];
    for (int k = 0; k < kDepth; ++k)
      sum += double(left(all, lane() / 4 + i / 2 * 8, k)) * double(right(all, k, lane() % 4 * 2 + i % 2));
    *d[i] = float(sum);
  }
}

struct Factors {
  uint32_t a[4], b[2];
};

// a: rows r and r + 8 at q, then at q + 4; b: q and q + 4 of column r. The last 13 bits of a number are dropped.
inline void mma_sync_aligned_m16n8k8_row_col_f32_tf32_tf32_f32(float& d0, float& d1, float& d2, float& d3, uint32_t a0,
                                                               uint32_t a1, uint32_t a2, uint32_t a3, uint32_t b0,
                                                               uint32_t b1) {
  const auto number = [](uint32_t bits) { return bits_as<float>(bits & 0xffffe000u); };
  multiply<8>(
      d0, d1, d2, d3, Factors{{a0, a1, a2, a3}, {b0, b1}},
      [=](const Lanes<Factors>& all, int row, int k) { return number(all[row % 8 * 4 + k % 4].a[k / 4 * 2 + row / 8]); },
      [=](const Lanes<Factors>& all, int k, int column) { return number(all[column * 4 + k % 4].b[k / 4]); });
}

// Twos of bfloat16s; a: rows r and r + 8 at 2 q and 2 q + 1, then 8 further on; b: these rows of column r.
inline void mma_sync_aligned_m16n8k16_row_col_f32_bf16_bf16_f32(float& d0, float& d1, float& d2, float& d3, uint32_t a0,
                                                                uint32_t a1, uint32_t a2, uint32_t a3, uint32_t b0,
                                                                uint32_t b1) {
  const auto number = [](uint32_t two, int k) { return bits_as<float>(k % 2 == 0 ? two << 16 : two & 0xffff0000u); };
  multiply<16>(
      d0, d1, d2, d3, Factors{{a0, a1, a2, a3}, {b0, b1}},
      [=](const Lanes<Factors>& all, int row, int k) {
        return number(all[row % 8 * 4 + k % 8 / 2].a[k / 8 * 2 + row / 8], k);
      },
      [=](const Lanes<Factors>& all, int k, int column) { return number(all[column * 4 + k % 8 / 2].b[k / 8], k); });
}

// Matrix i of four: its rows of eight numbers of two bytes are where lanes 8 i .. 8 i + 7 say.
inline uint32_t word_of(const Lanes<unsigned>& rows, int matrix, int row, int word) {
  uint32_t found;
  std::memcpy(&found, state.shared + rows[matrix * 8 + row] + word * 4, 4);
  return found;
}

inline void ldmatrix_sync_aligned_m8n8_x4_shared_b16(uint32_t& to0, uint32_t& to1, uint32_t& to2, uint32_t& to3,
                                                     unsigned row) {
  const Lanes<unsigned> rows = of_warp(~0u, row);
  uint32_t* const to[4] = {&to0, &to1, &to2, &to3};
  for (int i = 0; i < 4; ++i) *to[i] = word_of(rows, i, lane() / 4, lane() % 4);
  of_warp(~0u, 0);  // nobody goes on before all have read
}

inline void ldmatrix_sync_aligned_m8n8_x4_trans_shared_b16(uint32_t& to0, uint32_t& to1, uint32_t& to2, uint32_t& to3,
                                                           unsigned row) {
  const Lanes<unsigned> rows = of_warp(~0u, row);
  uint32_t* const to[4] = {&to0, &to1, &to2, &to3};
  const int column = lane() / 4, shift = column % 2 * 16;
  for (int i = 0; i < 4; ++i) {
    const uint32_t upper = word_of(rows, i, lane() % 4 * 2, column / 2) >> shift;
    const uint32_t lower = word_of(rows, i, lane() % 4 * 2 + 1, column / 2) >> shift;
    *to[i] = (upper & 0xffffu) | lower << 16;
  }
  of_warp(~0u, 0);
}

inline void stmatrix_sync_aligned_m8n8_x4_shared_b16(unsigned row, uint32_t from0, uint32_t from1, uint32_t from2,
                                                     uint32_t from3) {
  const Lanes<unsigned> rows = of_warp(~0u, row);
  const uint32_t from[4] = {from0, from1, from2, from3};
  for (int i = 0; i < 4; ++i) std::memcpy(state.shared + rows[i * 8 + lane() / 4] + lane() % 4 * 4, &from[i], 4);
  of_warp(~0u, 0);
}

}  // namespace cuda_on_cpu

#endif  // __CUDACC__
