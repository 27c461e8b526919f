// Atomic sums on CUDA: of floats, which round each time, so that a sum depends on which block comes first; and sums that
// are the same in any order, of whole numbers of 64 bits in units of a power of two, which never round.
//
// The unit follows from the largest magnitude that is added and from how often: sums stay below 2^62. With a million
// addends it is 2^-42 of the largest one, where a float of that size has steps of 2^-24.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

#if defined(__CUDACC__)
#define SW_SUMS_HD __host__ __device__ __forceinline__
#else
#define SW_SUMS_HD inline
#endif

namespace sw_sums {

// A sum: two's complement, as atomicAdd takes it.
using Whole = unsigned long long;

// 2^exponent, for -126 .. 127.
SW_SUMS_HD float power_of_two(int exponent) {
  union {
    uint32_t bits;
    float value;
  } found = {uint32_t(exponent + 127) << 23};
  return found.value;
}

SW_SUMS_HD bool is_finite(float largest) { return largest <= 3.402823466e38f; }

// Bits behind the point, so that `count` numbers of at most `largest` add up to less than 2^62.
SW_SUMS_HD int fraction_bits(float largest, int64_t count) {
  union {
    float value;
    uint32_t bits;
  } of = {largest};
  const int exponent = int(of.bits >> 23 & 255) - 126;  // largest < 2^exponent
  int count_bits = 0;
  while (count_bits < 40 && int64_t(1) << count_bits < count) ++count_bits;
  const int found = 62 - exponent - count_bits;
  return found < 120 ? found : 120;  // both powers of two are normal numbers
}

// Where sums of at most `count` numbers each stand, none beyond *largest, which is on the device.
struct Sums {
  Whole* to;
  const float* largest;
  int64_t count;
};

#if defined(__CUDACC__)
struct FloatAdder {
  float* to;

  __device__ explicit FloatAdder(float* table) : to(table) {}
  __device__ __forceinline__ void add(int64_t at, float value) const { atomicAdd(to + at, value); }
};

// Adds floats as whole numbers; each thread makes its own.
struct WholeAdder {
  Whole* to;
  float unit;

  __device__ explicit WholeAdder(const Sums& sums)
      : to(sums.to), unit(power_of_two(fraction_bits(*sums.largest, sums.count))) {}
  __device__ __forceinline__ void add(int64_t at, float value) const {
    atomicAdd(to + at, Whole(__float2ll_rn(value * unit)));
  }
};

// A sum as a float; NaN where something that was added is not finite.
__device__ __forceinline__ float value_of(Whole sum, float largest, int64_t count) {
  if (!is_finite(largest)) return __int_as_float(0x7fffffff);
  return __ll2float_rn((long long)(sum)) * power_of_two(-fraction_bits(largest, count));
}
#endif

}  // namespace sw_sums
