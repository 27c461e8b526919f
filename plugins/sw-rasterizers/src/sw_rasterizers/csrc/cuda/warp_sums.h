// Sums of many values at once over the lanes of a warp.
#pragma once

#include "device.h"

namespace sw::cuda {

// Adds values[0..kCount) over the lanes; a lane ends up with the total of the value `spread_index` tells. Each step
// halves the number of values a lane holds, so that 9 values take 12 shuffles and not 45.
template <int kCount, int kStep = kWarp / 2>
__device__ __forceinline__ float spread_sums(const float* values) {
  if constexpr (kStep == 0) {
    return values[0];
  } else if constexpr (kCount == 1) {
    const float sum = values[0] + __shfl_xor_sync(kAllLanes, values[0], kStep);
    return spread_sums<1, kStep / 2>(&sum);
  } else {
    constexpr int kKept = (kCount + 1) / 2;
    const bool upper = lane_index() & kStep;
    float kept[kKept];
#pragma unroll
    for (int i = 0; i < kKept; ++i) {
      const float low = values[i], high = kKept + i < kCount ? values[kKept + i] : 0.f;
      kept[i] = (upper ? high : low) + __shfl_xor_sync(kAllLanes, upper ? low : high, kStep);
    }
    return spread_sums<kKept, kStep / 2>(kept);
  }
}

// -1: another lane has the same total.
template <int kCount, int kStep = kWarp / 2>
__device__ __forceinline__ int spread_index(int lane) {
  if constexpr (kStep == 0) {
    return 0;
  } else {
    constexpr int kKept = (kCount + 1) / 2;
    const int in_half = spread_index<kKept, kStep / 2>(lane);
    if (in_half < 0) return -1;
    if constexpr (kCount == 1) return lane & kStep ? -1 : in_half;
    const int index = lane & kStep ? kKept + in_half : in_half;
    return index < kCount ? index : -1;
  }
}

}  // namespace sw::cuda
