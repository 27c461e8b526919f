// Sums over the items of each group that are the same in every run: a warp a group, a lane every 32nd item of it in
// their order, then the lanes pairwise. Atomics would add in the order in which blocks happen to end.
#pragma once

#include "kernels.h"
#include "warp_sums.h"

namespace sw::cuda {

constexpr int kGroupWarps = 4;

// values [items][kParts][kSums]; `put(group, which, total)` takes each of the totals, on one lane.
template <int kSums, int kParts, class Put>
__global__ void __launch_bounds__(kGroupWarps* kWarp)
    sum_groups_kernel(int64_t count, Groups groups, const float* values, Put put) {
  const int64_t group = int64_t(blockIdx.x) * kGroupWarps + warp_index();
  if (group >= count) return;
  const int end = groups.start[group + 1];
  float sums[kSums] = {};
  for (int i = groups.start[group] + lane_index(); i < end; i += kWarp) {
    const float* item = values + int64_t(groups.item[i]) * (kParts * kSums);
#pragma unroll
    for (int k = 0; k < kParts * kSums; ++k) sums[k % kSums] += item[k];
  }
  const float total = spread_sums<kSums>(sums);
  const int which = spread_index<kSums>(lane_index());
  if (which >= 0) put(group, which, total);
}

template <int kSums, int kParts = 1, class Put>
void sum_groups(int64_t count, const Groups& groups, const float* values, const Put& put, cudaStream_t stream) {
  if (count > 0)
    sum_groups_kernel<kSums, kParts>
        <<<unsigned(ceil_div(count, kGroupWarps)), kGroupWarps * kWarp, 0, stream>>>(count, groups, values, put);
}

// Where a sum of a splat goes that is a score of its Gaussian.
struct PutTotal {
  const float2* tail;
  double* total;
  __device__ __forceinline__ void operator()(int64_t splat, int, float sum) const {
    total[__float_as_int(tail[splat].y)] += double(sum);
  }
};

}  // namespace sw::cuda
