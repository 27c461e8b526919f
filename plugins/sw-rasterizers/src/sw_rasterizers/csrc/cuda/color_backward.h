// From dL/dcolour of a warp's Gaussians to the gradients of their coefficients and, through the viewing direction, of
// their positions.
#pragma once

#include "../sh.h"
#include "gather.h"
#include "kernels.h"

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

// The same, and at once Adam's step. The values of a warp's Gaussians are one run: four a lane, kBatch times before any
// is waited for.
template <int kFloats>
__device__ __forceinline__ void update_sh_values(const RowAdam& a, int64_t first, int rows, int first_basis,
                                                 const float* factors) {
  constexpr int kBatch = 3;
  const int values = rows * kFloats;
  float* const p = a.param + first * kFloats;
  float* const m = a.exp_avg + first * kFloats;
  float* const v = a.exp_avg_sq + first * kFloats;
  const auto gradient = [&](int at) {
    const int row = at / kFloats, value = at % kFloats, k = first_basis + value / 3;
    // Rounded before it is used, as where it is written: the steps are the same.
    return __fmul_rn(factors[row * kFactors + k], factors[row * kFactors + kMaxBasis + value % 3]);
  };
  const auto update = [&](float& p, float g, float& m, float& v) {
    m = m + a.one_minus_beta1 * (g - m);
    v = a.beta2 * v + a.one_minus_beta2 * g * g;
    p -= a.step_size * m / (sqrtf(v) * a.inv_bias2 + a.eps);
  };
  const auto is_zero = [](float4 x) {  // bit patterns: -0.0 and NaN count as not zero
    return (__float_as_uint(x.x) | __float_as_uint(x.y) | __float_as_uint(x.z) | __float_as_uint(x.w)) == 0;
  };
  for (int start = 4 * lane_index(); start < values; start += 4 * kWarp * kBatch) {
    float4 p4[kBatch], m4[kBatch], v4[kBatch];
#pragma unroll
    for (int b = 0; b < kBatch; ++b) {
      const int i = start + 4 * kWarp * b;
      if (i + 4 > values) continue;
      m4[b] = __ldcs(reinterpret_cast<const float4*>(m + i)), v4[b] = __ldcs(reinterpret_cast<const float4*>(v + i));
      p4[b] = *reinterpret_cast<const float4*>(p + i);
    }
#pragma unroll
    for (int b = 0; b < kBatch; ++b) {
      const int i = start + 4 * kWarp * b;
      if (i + 4 > values) {
        for (int j = i; j < values; ++j) update(p[j], gradient(j), m[j], v[j]);
        continue;
      }
      const float4 g4 = make_float4(gradient(i), gradient(i + 1), gradient(i + 2), gradient(i + 3));
      if (a.eps > 0.f && is_zero(g4) && is_zero(m4[b]) && is_zero(v4[b])) continue;  // bands that are not yet trained
      update(p4[b].x, g4.x, m4[b].x, v4[b].x);
      update(p4[b].y, g4.y, m4[b].y, v4[b].y);
      update(p4[b].z, g4.z, m4[b].z, v4[b].z);
      update(p4[b].w, g4.w, m4[b].w, v4[b].w);
      *reinterpret_cast<float4*>(p + i) = p4[b];
      __stcs(reinterpret_cast<float4*>(m + i), m4[b]);
      __stcs(reinterpret_cast<float4*>(v + i), v4[b]);
    }
  }
}
__device__ __forceinline__ void update_sh_rows(const RowAdam& a, int64_t first, int rows, int floats, int first_basis,
                                               const float* factors) {
  switch (floats) {
    case 3: return update_sh_values<3>(a, first, rows, first_basis, factors);
    case 9: return update_sh_values<9>(a, first, rows, first_basis, factors);
    case 24: return update_sh_values<24>(a, first, rows, first_basis, factors);
    case 45: return update_sh_values<45>(a, first, rows, first_basis, factors);
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
// coefficients that have been read. kAdam: what `adam` names is updated instead.
template <bool kAdam = false>
__device__ __forceinline__ void write_sh_gradient(const Gaussians<float>& g, const Gradients<float>& out, int64_t first,
                                                  const float* basis, const float* color, float* shared,
                                                  const ShAdam& adam = {}) {
  if (!kAdam && out.sh_dc == nullptr && out.sh_rest == nullptr) return;

  __syncwarp();  // all have read their coefficients
  float* mine = shared + lane_index() * kFactors;
#pragma unroll
  for (int k = 0; k < kMaxBasis; ++k) mine[k] = basis[k];
#pragma unroll
  for (int k = 0; k < 3; ++k) mine[kMaxBasis + k] = color[k];
  __syncwarp();
  const int count = int(min(int64_t(kWarp), g.count - first));
  if constexpr (kAdam) {
    if (adam.dc.param != nullptr) update_sh_rows(adam.dc, first, count, 3, 0, shared);
    if (adam.rest.param != nullptr) update_sh_rows(adam.rest, first, count, int(g.sh_rest_stride), 1, shared);
  }
  const bool dense = out.sh_dc != nullptr && out.sh_dc_stride > 3;
  if (out.sh_dc != nullptr) write_sh_rows(out.sh_dc, first, count, int(out.sh_dc_stride), 0, shared);
  if (!dense && out.sh_rest != nullptr)
    write_sh_rows(out.sh_rest, first, count, int(out.sh_rest_stride), 1, shared);
}

}  // namespace sw::cuda
