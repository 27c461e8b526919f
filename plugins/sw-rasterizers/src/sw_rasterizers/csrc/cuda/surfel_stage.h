// Surfels of a tile's list in shared memory, and which of the tile's boxes each of them may touch.
#pragma once

#include "splat.h"
#include "surfel_kernels.h"

namespace sw::cuda {

constexpr int kPlaneQuads = kPlane / 4;

template <int kThreads>
struct SurfelStage {
  static constexpr int kWords = kThreads / kWarp;
  float4 plane[kPlaneQuads][kThreads];
  float4 color[kThreads];           // log2 of the opacity, red, green, blue
  int gaussian[kThreads];
  unsigned words[kBoxes][kWords];   // bit i of word w: surfel 32 w + i may touch the box

  // By all threads of the block, one surfel each; `used` where there is one. Synchronise before and after.
  __device__ __forceinline__ void load(const Splats& splats, int slot, bool used, bool tight, int x0, int y0) {
    unsigned mask = 0;
    if (used) {
      const float4 s0 = splats.shape[2 * int64_t(slot)], s1 = splats.shape[2 * int64_t(slot) + 1];
      const float2 tail = splats.tail[slot];
      const float4* row = reinterpret_cast<const float4*>(splats.channels) + int64_t(slot) * kPlaneQuads;
      float values[kPlane];
#pragma unroll
      for (int k = 0; k < kPlaneQuads; ++k) {
        const float4 quad = row[k];
        plane[k][threadIdx.x] = quad;
        values[4 * k] = quad.x, values[4 * k + 1] = quad.y, values[4 * k + 2] = quad.z, values[4 * k + 3] = quad.w;
      }
      color[threadIdx.x] = make_float4(s1.y, s1.z, s1.w, tail.x);
      gaussian[threadIdx.x] = __float_as_int(tail.y);
      // The ellipse tells little of a surfel near the camera, the plane little of one that is small: both are asked.
      mask = plane_mask(values, s1.y, x0, y0);
      if (tight && mask != 0) mask &= box_mask(s0.x, s0.y, s0.z, s0.w, s1.x, s1.y, x0, y0);
    }
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const unsigned word = __ballot_sync(kAllLanes, mask >> b & 1);
      if (lane_index() == b) words[b][warp_index()] = word;
    }
  }

  __device__ __forceinline__ void read_plane(int k, float* values) const {
#pragma unroll
    for (int i = 0; i < kPlaneQuads; ++i) {
      const float4 quad = plane[i][k];
      values[4 * i] = quad.x, values[4 * i + 1] = quad.y, values[4 * i + 2] = quad.z, values[4 * i + 3] = quad.w;
    }
  }

 private:
  static __device__ __forceinline__ unsigned plane_mask(const float* values, float opacity_level, int x0, int y0) {
    const float level = float(2 * kLn2) * cutoff_of(opacity_level), dot = square_root(float(kSurfelDot) * level);
    constexpr float kHalfX = 0.5f * kBoxWidth, kHalfY = 0.5f * kBoxHeight;
    unsigned mask = 0;
#pragma unroll
    for (int b = 0; b < kBoxes; ++b) {
      const float x = float(x0 + b % kBoxColumns * kBoxWidth) + kHalfX;
      const float y = float(y0 + b / kBoxColumns * kBoxHeight) + kHalfY;
      if (surfel_meets_box<float>(values, level, dot, x, y, kHalfX, kHalfY)) mask |= 1u << b;
    }
    return mask;
  }
};

}  // namespace sw::cuda
