// Scales and quaternions of a pack of Gaussians, from rows of their own or from shared ones.
#pragma once

#include "../call.h"
#include "../projection.h"
#include "gather.h"

namespace SW_ARCH {
using namespace sw;

// Rows of scales and quats that rows[0..L) have.
template <class V>
SW_HD void shape_rows_of(const Gaussians<Scalar<V>>& g, const int32_t* rows, int32_t* shapes) {
  for (int i = 0; i < lanes_of<V>; ++i) shapes[i] = int32_t(g.shape_of(rows[i]));
}

// Fills in.scale, multiplied by the factors, and in.quat.
template <class V>
SW_HD void gather_shape(const Gaussians<Scalar<V>>& g, const int32_t* rows, Geometry<V>& in) {
  if (g.shape_rows == nullptr) {
    gather_rows<V, 3>(g.scales, 3, rows, in.scale);
    gather_rows<V, 4>(g.quats, 4, rows, in.quat);
  } else {
    alignas(64) int32_t shapes[lanes_of<V>];
    shape_rows_of<V>(g, rows, shapes);
    gather_rows<V, 3>(g.scales, 3, shapes, in.scale);
    gather_rows<V, 4>(g.quats, 4, shapes, in.quat);
  }
  if (g.scale_factors != nullptr) {
    V factor;
    gather_rows<V, 1>(g.scale_factors, 1, rows, &factor);
    for (V& x : in.scale) x *= factor;
  }
}

// From dL/d(scales as drawn) and dL/dquat of the first `count` rows to what was put in. `sums`: the shared rows of
// their group, or null.
template <class V>
SW_HD void scatter_shape(const Gaussians<Scalar<V>>& g, const Gradients<Scalar<V>>& out, Scalar<V>* sums,
                         const int32_t* rows, int count, V* scale, V* quat) {
  using S = Scalar<V>;
  constexpr int L = lanes_of<V>;
  alignas(64) int32_t shapes[L];
  shape_rows_of<V>(g, rows, shapes);
  if (g.scale_factors != nullptr) {
    V factor, own[3];
    gather_rows<V, 1>(g.scale_factors, 1, rows, &factor);
    gather_rows<V, 3>(g.scales, 3, shapes, own);
    const V slope = scale[0] * own[0] + scale[1] * own[1] + scale[2] * own[2];
    if (out.scale_factors != nullptr) scatter_rows<V, 1>(&slope, out.scale_factors, 1, rows, count);
    for (int k = 0; k < 3; ++k) scale[k] *= factor;
  }
  if (g.shape_rows == nullptr) {
    if (out.scales != nullptr) scatter_rows<V, 3>(scale, out.scales, 3, rows, count);
    if (out.quats != nullptr) scatter_rows<V, 4>(quat, out.quats, 4, rows, count);
  } else if (sums != nullptr) {
    alignas(64) S buffer[kShapeSums][L];
    for (int k = 0; k < 3; ++k) store(buffer[k], scale[k]);
    for (int k = 0; k < 4; ++k) store(buffer[3 + k], quat[k]);
    for (int i = 0; i < count; ++i) {  // one after the other: two lanes may have the same row
      S* row = sums + int64_t(shapes[i]) * kShapeSums;
      for (int k = 0; k < kShapeSums; ++k) row[k] += buffer[k][i];
    }
  }
}

}  // namespace SW_ARCH
