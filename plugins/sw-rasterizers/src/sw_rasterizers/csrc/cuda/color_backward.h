// From dL/dcolour of a warp's Gaussians to the gradients of their coefficients and, through the viewing direction, of
// their positions.
#pragma once

#include "../sh.h"
#include "gather.h"

namespace sw::cuda {

constexpr int kFactors = kMaxBasis + 3;  // a Gaussian's basis and colour gradient; odd: no bank conflicts

// dL/dsh_k = B_k dL/dcolour: the rows of a warp's Gaussians, a row at a time, a value a lane.
__device__ __forceinline__ void write_sh_rows(float* base, int64_t first, int rows, int floats, int first_basis,
                                              const float* factors) {
  for (int value = lane_index(); value < floats; value += kWarp) {
    const int k = first_basis + value / 3, channel = value % 3;
    float* to = base + first * floats + value;
    if (k < kMaxBasis) {
#pragma unroll 4
      for (int row = 0; row < rows; ++row)
        to[int64_t(row) * floats] = factors[row * kFactors + k] * factors[row * kFactors + kMaxBasis + channel];
    } else {
      for (int row = 0; row < rows; ++row) to[int64_t(row) * floats] = 0.f;
    }
  }
}

// Adds the part of dL/dmean that goes through the viewing direction; `rest`: the Gaussian's coefficients but the first.
__device__ __forceinline__ void add_color_slope(int degree, const float* direction, float inverse_length,
                                                const float* rest, const float* color, float* mean_gradient) {
  float dx[kMaxBasis], dy[kMaxBasis], dz[kMaxBasis], slope[3] = {};
  sh_basis_gradient(degree, direction[0], direction[1], direction[2], dx, dy, dz);
#pragma unroll
  for (int k = 1; k < kMaxBasis; ++k) {
    if (k >= (degree + 1) * (degree + 1)) break;
    const float* sh = rest + 3 * (k - 1);
    const float along = sh[0] * color[0] + sh[1] * color[1] + sh[2] * color[2];
    slope[0] += dx[k] * along, slope[1] += dy[k] * along, slope[2] += dz[k] * along;
  }
  const float radial = dot3(direction, slope);
#pragma unroll
  for (int j = 0; j < 3; ++j) mean_gradient[j] += (slope[j] - direction[j] * radial) * inverse_length;
}

// By all lanes of a warp, for its Gaussians from `first` on. `shared`, kWarp * kRestFloats of the warp's own, may hold
// coefficients that have been read.
__device__ __forceinline__ void write_sh_gradient(const Gaussians<float>& g, const Gradients<float>& out, int64_t first,
                                                  const float* basis, const float* color, float* shared) {
  if (out.sh_dc == nullptr && out.sh_rest == nullptr) return;

  __syncwarp();  // all have read their coefficients
  float* mine = shared + lane_index() * kFactors;
#pragma unroll
  for (int k = 0; k < kMaxBasis; ++k) mine[k] = basis[k];
#pragma unroll
  for (int k = 0; k < 3; ++k) mine[kMaxBasis + k] = color[k];
  __syncwarp();
  const int count = int(min(int64_t(kWarp), g.count - first));
  const bool dense = out.sh_dc != nullptr && out.sh_dc_stride > 3;
  if (out.sh_dc != nullptr) write_sh_rows(out.sh_dc, first, count, int(out.sh_dc_stride), 0, shared);
  if (!dense && out.sh_rest != nullptr)
    write_sh_rows(out.sh_rest, first, count, int(out.sh_rest_stride), 1, shared);
}

}  // namespace sw::cuda
