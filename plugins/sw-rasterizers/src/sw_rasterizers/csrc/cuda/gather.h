// Loads and stores of per-Gaussian rows.
#pragma once

#include "../call.h"
#include "../projection.h"
#include "device.h"

namespace sw::cuda {

template <int kCount>
__device__ __forceinline__ void load_row(const float* base, int64_t n, float* to) {
#pragma unroll
  for (int k = 0; k < kCount; ++k) to[k] = base[n * kCount + k];
}
template <>
__device__ __forceinline__ void load_row<4>(const float* base, int64_t n, float* to) {
  const float4 row = reinterpret_cast<const float4*>(base)[n];
  to[0] = row.x, to[1] = row.y, to[2] = row.z, to[3] = row.w;
}
template <int kCount>
__device__ __forceinline__ void store_row(float* base, int64_t n, const float* from) {
#pragma unroll
  for (int k = 0; k < kCount; ++k) base[n * kCount + k] = from[k];
}
template <>
__device__ __forceinline__ void store_row<4>(float* base, int64_t n, const float* from) {
  reinterpret_cast<float4*>(base)[n] = make_float4(from[0], from[1], from[2], from[3]);
}

template <bool kCov3d>
__device__ __forceinline__ void load_geometry(const Gaussians<float>& g, int64_t n, Geometry<float>& to) {
  load_row<3>(g.means, n, to.mean);
  if constexpr (kCov3d) {
    load_row<6>(g.cov3d, n, to.cov);
  } else {
    const int64_t shape = g.shape_of(n);
    load_row<3>(g.scales, shape, to.scale);
    load_row<4>(g.quats, shape, to.quat);
    if (g.scale_factors != nullptr) {
      const float factor = g.scale_factors[n];
#pragma unroll
      for (int k = 0; k < 3; ++k) to.scale[k] *= factor;
    }
  }
}

// Rows of spherical harmonics (all but the first coefficient) of a warp's Gaussians, through shared memory: a warp
// copies row after row, coalesced; then each lane reads its own. Rows lie an odd number of floats apart: no bank
// conflict when all lanes read the same field of theirs.
constexpr int kRestFloats = 45;

// `wanted`: whether this lane needs its row. Returns this lane's row; valid after async_wait and __syncwarp.
__device__ __forceinline__ float* stage_rest(const Gaussians<float>& g, int64_t n, bool wanted, int floats,
                                             float* shared) {
  const int lane = lane_index();
  for (unsigned left = __ballot_sync(kAllLanes, wanted); left != 0; left &= left - 1) {
    const int row = __ffs(int(left)) - 1;
    const float* from = g.sh_rest + __shfl_sync(kAllLanes, n, row) * g.sh_rest_stride;
    if (lane < floats) async_copy(shared + row * kRestFloats + lane, from + lane);
    if (lane + kWarp < floats) async_copy(shared + row * kRestFloats + kWarp + lane, from + kWarp + lane);
  }
  return shared + lane * kRestFloats;
}

__device__ __forceinline__ int rest_floats(int degree) { return 3 * ((degree + 1) * (degree + 1) - 1); }

// Unit vector from the camera to a point, and 1 / distance.
__device__ __forceinline__ float view_direction(const View<float>& view, const float* mean, float* direction) {
#pragma unroll
  for (int j = 0; j < 3; ++j) direction[j] = mean[j] - view.center[j];
  const float inverse_length = 1.f / square_root(dot3(direction, direction));
#pragma unroll
  for (int j = 0; j < 3; ++j) direction[j] *= inverse_length;
  return inverse_length;
}

}  // namespace sw::cuda
