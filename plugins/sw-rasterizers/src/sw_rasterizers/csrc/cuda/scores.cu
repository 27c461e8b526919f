// Contribution sums: a block of 8 warps a tile, a warp a box of 8 x 4 pixels, front to back as in `blend`.
//
// A warp adds up each score over its 32 pixels and adds the sums to the Gaussian's totals, in float64: counts and maxima
// are exact whatever the order, the rest varies in its last bits from run to run. Where sums are to have one order, these
// are formed one score a launch: a warp leaves its part at the pair, and those of a splat are added up in a second kernel.
#include "../blend.h"
#include "groups.h"
#include "score_kernels.h"
#include "splat.h"

namespace sw::cuda {
namespace {

constexpr int kThreads = kBoxes * kWarp, kWords = kThreads / kWarp;

__device__ __forceinline__ float lanes_sum(float value) {
  for (int step = kWarp / 2; step > 0; step /= 2) value += __shfl_xor_sync(kAllLanes, value, step);
  return value;
}
__device__ __forceinline__ float lanes_maximum(float value) {
  for (int step = kWarp / 2; step > 0; step /= 2) value = fmaxf(value, __shfl_xor_sync(kAllLanes, value, step));
  return value;
}

// What one pixel adds; `counted` is 1 or 0.
__device__ __forceinline__ float pixel_value(const Score<float>& score, float counted, float alpha, float before,
                                             float dx, float dy) {
  switch (score.kind) {
    case kOpacityT:
      return counted * before;
    case kBlend:
    case kBlendMax:
      return counted * alpha * before;
    case kBlendSq:
      return counted * (alpha * before) * (alpha * before);
    case kShown:
      return alpha * before > float(kShownMin) ? counted : 0.f;
    case kGamma:
      if (counted == 0.f) return 0.f;
      return exp2f(2.f * (score.gamma * log2f(alpha) + (1.f - score.gamma) * log2f(before)));
    case kDist:
      return counted * sqrtf(dx * dx + dy * dy);
    default:  // hits, opacity
      return counted;
  }
}

__global__ void __launch_bounds__(kThreads)
    score_kernel(View<float> view, Splats splats, TileLists lists, const __grid_constant__ Scores<float> scores,
                 const __grid_constant__ Totals totals, float* pair_sums) {
  __shared__ float4 shape[2][kThreads];
  __shared__ int gaussian[kThreads];
  __shared__ unsigned words[kBoxes][kWords];  // bit i of word w: splat 32 w + i reaches the box
  const int tile = int(blockIdx.x), tiles_x = view.tiles_x();
  const int x0 = tile % tiles_x * kTile, y0 = tile / tiles_x * kTile, box = warp_index();
  const int x = x0 + box % kBoxColumns * kBoxWidth + lane_index() % kBoxWidth;
  const int y = y0 + box / kBoxColumns * kBoxHeight + lane_index() / kBoxWidth;
  const bool inside = x < view.width && y < view.height;
  const int64_t pixel = inside ? int64_t(y) * view.width + x : 0;
  const float centre_x = float(x) + 0.5f, centre_y = float(y) + 0.5f;
  const int begin = lists.start[tile], end = lists.start[tile + 1];

  float transmittance = inside ? 1.f : -1.f;  // negative: finished
  for (int first = begin; first < end; first += kThreads) {
    if (__syncthreads_and(transmittance < 0.f)) break;
    const int at = first + int(threadIdx.x);
    unsigned mask = 0;
    if (at < end) {
      const int slot = lists.splat[at];
      const float4 s0 = splats.shape[2 * int64_t(slot)], s1 = splats.shape[2 * int64_t(slot) + 1];
      shape[0][threadIdx.x] = s0, shape[1][threadIdx.x] = s1;
      gaussian[threadIdx.x] = __float_as_int(splats.tail[slot].y);
      mask = box_mask(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, x0, y0);
    }
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const unsigned word = __ballot_sync(kAllLanes, mask >> b & 1);
      if (lane_index() == b) words[b][warp_index()] = word;
    }
    __syncthreads();

    for (int w = 0; w < kWords; ++w) {
      if (__all_sync(kAllLanes, transmittance < 0.f)) break;
      for (unsigned word = words[box][w]; word != 0; word &= word - 1) {
        const int k = w * kWarp + __ffs(int(word)) - 1;
        const float4 s0 = shape[0][k], s1 = shape[1][k];
        const float dx = s0.x - centre_x, dy = s0.y - centre_y;
        const float power = log2_alpha(dx, dy, s0.z, s0.w, s1.x, s1.y), before = transmittance;
        const bool tried = power >= float(kLog2AlphaMin) && before > 0.f;
        if (!__any_sync(kAllLanes, tried)) continue;
        const float alpha = tried ? fminf(float(kAlphaMax), exp_2(power)) : 0.f;
        const bool blended = tried && composite(alpha, transmittance) > 0.f;
        const float opacity = exp_2(s1.y);
        float mine = 0.f;  // a lane a score
        for (int s = 0; s < scores.count; ++s) {
          const Score<float>& score = scores.of[s];
          const bool counted = score.tested ? tried : blended;
          float total;
          if (score.weight == nullptr && (score.kind == kHits || score.kind == kOpacity)) {
            total = float(__popc(__ballot_sync(kAllLanes, counted)));
          } else {
            float value = pixel_value(score, counted ? 1.f : 0.f, alpha, before, dx, dy);
            if (score.weight != nullptr) value *= score.weight[pixel];
            total = score.kind == kBlendMax ? lanes_maximum(value) : lanes_sum(value);
          }
          if (score.kind == kOpacity || score.kind == kOpacityT) total *= opacity;
          if (lane_index() == s) mine = total;
        }
        if (lane_index() >= scores.count || mine == 0.f) continue;
        if (pair_sums != nullptr) {  // of the one score
          pair_sums[(int64_t(first) + k) * kScoreParts + box] = mine;
          continue;
        }
        double* to = totals.of[lane_index()] + gaussian[k];
        if (scores.of[lane_index()].kind != kBlendMax)
          atomicAdd(to, double(mine));
        else if (mine > 0.f)  // positive doubles order like their bits
          atomicMax(reinterpret_cast<unsigned long long*>(to),
                    static_cast<unsigned long long>(__double_as_longlong(double(mine))));
      }
    }
  }
}

}  // namespace

void score_pixels(const View<float>& view, const Splats& splats, const TileLists& lists, const Scores<float>& scores,
                  const Totals& totals, const Ordered& ordered, cudaStream_t stream) {
  static_assert(kScoreParts == kBoxes);
  const unsigned tiles = unsigned(view.tiles_x()) * unsigned(view.tiles_y());
  if (ordered.pair_sums == nullptr) {
    score_kernel<<<tiles, kThreads, 0, stream>>>(view, splats, lists, scores, totals, nullptr);
    return;
  }
  for (int s = 0; s < scores.count; ++s) {
    Scores<float> one;
    one.of[one.count++] = scores.of[s];
    Totals to{};
    to.of[0] = totals.of[s];
    if (scores.of[s].kind == kBlendMax || (scores.of[s].kind == kHits && scores.of[s].weight == nullptr)) {
      score_kernel<<<tiles, kThreads, 0, stream>>>(view, splats, lists, one, to, nullptr);
      continue;
    }
    cudaMemsetAsync(ordered.pair_sums, 0, size_t(ordered.pairs) * kScoreParts * sizeof(float), stream);
    score_kernel<<<tiles, kThreads, 0, stream>>>(view, splats, lists, one, to, ordered.pair_sums);
    sum_groups<1, kScoreParts>(ordered.splats, ordered.pairs_of_splat, ordered.pair_sums,
                               PutTotal{splats.tail, to.of[0]}, stream);
  }
}

}  // namespace sw::cuda
