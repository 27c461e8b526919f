// The rotation matrix of a quaternion of any norm, and its derivative.
#pragma once

#include "common.h"

namespace sw {

template <class V>
SW_HD V dot3(const V* a, const V* b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

// (w, x, y, z) -> Rq, rows, local axes to world; `unit` receives the normalised quaternion. Returns 1 / |q|.
template <class V>
SW_HD V rotation_of(const V* quat, V* unit, V* m) {
  const auto c = [](double value) { return constant<V>(value); };
  const V norm2 = quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3];
  const V inverse_norm = c(1) / square_root(norm2);
  for (int i = 0; i < 4; ++i) unit[i] = quat[i] * inverse_norm;
  const V r = unit[0], x = unit[1], y = unit[2], z = unit[3], two = c(2), one = c(1);
  m[0] = one - two * (y * y + z * z), m[1] = two * (x * y - r * z), m[2] = two * (x * z + r * y);
  m[3] = two * (x * y + r * z), m[4] = one - two * (x * x + z * z), m[5] = two * (y * z - r * x);
  m[6] = two * (x * z - r * y), m[7] = two * (y * z + r * x), m[8] = one - two * (x * x + y * y);
  return inverse_norm;
}

// dL/dRq, rows -> dL/dq of the quaternion as given.
template <class V>
SW_HD void rotation_backward(const V* unit, V inverse_norm, const V* gr, V* out) {
  const V two = constant<V>(2), r = unit[0], x = unit[1], y = unit[2], z = unit[3];
  V q[4];
  q[0] = two * (x * (gr[7] - gr[5]) + y * (gr[2] - gr[6]) + z * (gr[3] - gr[1]));
  q[1] = two * (y * (gr[1] + gr[3]) + z * (gr[2] + gr[6]) + r * (gr[7] - gr[5]) - two * x * (gr[4] + gr[8]));
  q[2] = two * (x * (gr[1] + gr[3]) + z * (gr[5] + gr[7]) + r * (gr[2] - gr[6]) - two * y * (gr[0] + gr[8]));
  q[3] = two * (x * (gr[2] + gr[6]) + y * (gr[5] + gr[7]) + r * (gr[3] - gr[1]) - two * z * (gr[0] + gr[4]));
  const V radial = r * q[0] + x * q[1] + y * q[2] + z * q[3];
  for (int i = 0; i < 4; ++i) out[i] = (q[i] - unit[i] * radial) * inverse_norm;
}

}  // namespace sw
