// Real spherical harmonics up to degree 3 and their derivatives, in the sign convention of 3DGS.
//
// B_k(v) for the unit vector v = (x, y, z) from the camera to the Gaussian. Derivatives are those of the polynomials
// below; the projection onto the sphere (I - v v^T)/|mu - o| is the caller's.
#pragma once

#include "common.h"

namespace sw {

constexpr int kMaxBasis = 16;
constexpr double kSH0 = 0.28209479177387814;
constexpr double kSH1 = 0.4886025119029199;
// Functions, because device code sees no namespace-scope array.
SW_HD constexpr double sh_2(int k) {
  constexpr double values[] = {1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792,
                               0.5462742152960396};
  return values[k];
}
SW_HD constexpr double sh_3(int k) {
  constexpr double values[] = {-0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154,
                               -0.4570457994644658, 1.445305721320277, -0.5900435899266435};
  return values[k];
}

template <class V>
SW_HD void sh_basis(int degree, V x, V y, V z, V* basis) {
  const auto c = [](double value) { return constant<V>(value); };
  basis[0] = c(kSH0);
  if (degree < 1) return;
  basis[1] = c(-kSH1) * y;
  basis[2] = c(kSH1) * z;
  basis[3] = c(-kSH1) * x;
  if (degree < 2) return;
  const V xx = x * x, yy = y * y, zz = z * z;
  basis[4] = c(sh_2(0)) * x * y;
  basis[5] = c(sh_2(1)) * y * z;
  basis[6] = c(sh_2(2)) * (c(2) * zz - xx - yy);
  basis[7] = c(sh_2(3)) * x * z;
  basis[8] = c(sh_2(4)) * (xx - yy);
  if (degree < 3) return;
  basis[9] = c(sh_3(0)) * y * (c(3) * xx - yy);
  basis[10] = c(sh_3(1)) * x * y * z;
  basis[11] = c(sh_3(2)) * y * (c(4) * zz - xx - yy);
  basis[12] = c(sh_3(3)) * z * (c(2) * zz - c(3) * (xx + yy));
  basis[13] = c(sh_3(4)) * x * (c(4) * zz - xx - yy);
  basis[14] = c(sh_3(5)) * z * (xx - yy);
  basis[15] = c(sh_3(6)) * x * (xx - c(3) * yy);
}

// d basis / d(x, y, z): dx[k], dy[k], dz[k].
template <class V>
SW_HD void sh_basis_gradient(int degree, V x, V y, V z, V* dx, V* dy, V* dz) {
  const auto c = [](double value) { return constant<V>(value); };
  const V zero = c(0);
  const auto put = [&](int k, double factor, V gx, V gy, V gz) {
    dx[k] = c(factor) * gx, dy[k] = c(factor) * gy, dz[k] = c(factor) * gz;
  };
  put(0, 0, zero, zero, zero);
  if (degree < 1) return;
  put(1, -kSH1, zero, c(1), zero);
  put(2, kSH1, zero, zero, c(1));
  put(3, -kSH1, c(1), zero, zero);
  if (degree < 2) return;
  put(4, sh_2(0), y, x, zero);
  put(5, sh_2(1), zero, z, y);
  put(6, sh_2(2), c(-2) * x, c(-2) * y, c(4) * z);
  put(7, sh_2(3), z, zero, x);
  put(8, sh_2(4), c(2) * x, c(-2) * y, zero);
  if (degree < 3) return;
  const V xx = x * x, yy = y * y, zz = z * z, xy = x * y, xz = x * z, yz = y * z;
  put(9, sh_3(0), c(6) * xy, c(3) * (xx - yy), zero);
  put(10, sh_3(1), yz, xz, xy);
  put(11, sh_3(2), c(-2) * xy, c(4) * zz - xx - c(3) * yy, c(8) * yz);
  put(12, sh_3(3), c(-6) * xz, c(-6) * yz, c(6) * zz - c(3) * (xx + yy));
  put(13, sh_3(4), c(4) * zz - c(3) * xx - yy, c(-2) * xy, c(8) * xz);
  put(14, sh_3(5), c(2) * xz, c(-2) * yz, xx - yy);
  put(15, sh_3(6), c(3) * (xx - yy), c(-6) * xy, zero);
}

}  // namespace sw
