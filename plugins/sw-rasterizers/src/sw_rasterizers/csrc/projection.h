// Perspective projection of one Gaussian (or a pack of them) and its derivative.
//
// Forward:   t = R mu + tau,  J = d(u,v)/dt with tx/tz clamped,  A = J R
//            covariance from scale and rotation: P = A Rq diag(m s) (2x3), c0 = P P^T
//            covariance given (cov3d S):         c0 = A S A^T
//            c = c0 + eps I,  conic K = c^-1,  antialias factor rho = sqrt(max(2.5e-5, det c0 / det c))
// Backward:  Gc = -K GK K (+ antialias term),  GP = 2 Gc P,  then A, Rq, s, q and the mean.
//
// With P at hand det c0 = |p0 x p1|^2 and det c = det c0 + eps tr c0 + eps^2 are sums of squares: no cancellation,
// whatever the condition of c. That is what keeps needle-shaped splats right in float32.
#pragma once

#include "camera.h"
#include "rotation.h"

namespace sw {

template <class V>
struct Geometry {  // of one Gaussian, as given
  V mean[3];
  V scale[3], quat[4];  // unless cov3d
  V cov[6];             // if cov3d: xx xy xz yy yz zz
};

template <class V>
struct Projection {
  V t[3], inverse_z;
  V u, v;              // pixels
  V ratio_x, ratio_y;  // tx/tz, ty/tz after the clamp
  V free_x, free_y;    // 1 where the clamp is not active, else 0
  V rotation[9];       // Rq, rows (not with cov3d)
  V quat[4], inverse_norm;
  V row0[3], row1[3];  // P (A S with cov3d: rows of A S)
  V jr0[3], jr1[3];    // A = J R
  V c00, c01, c11;     // dilated covariance
  V det, det0;         // of the dilated and of the raw covariance
  V ka, kb, kc;        // conic
  V rho;               // antialias factor, 1 if off
};

template <class V>
SW_HD void camera_point(const View<Scalar<V>>& view, const V* mean, V* t) {
  for (int i = 0; i < 3; ++i)
    t[i] = view.rotation[3 * i] * mean[0] + view.rotation[3 * i + 1] * mean[1] + view.rotation[3 * i + 2] * mean[2] +
           view.translation[i];
}

template <bool kCov3d, class V>
SW_HD void project(const View<Scalar<V>>& view, Scalar<V> scale_modifier, Scalar<V> eps2d, bool antialias,
                   const Geometry<V>& g, Projection<V>& p) {
  const auto c = [](double value) { return constant<V>(value); };
  camera_point(view, g.mean, p.t);
  p.inverse_z = c(1) / p.t[2];
  const V x = p.t[0] * p.inverse_z, y = p.t[1] * p.inverse_z;
  p.u = view.fx * x + view.cx;
  p.v = view.fy * y + view.cy;
  const V x_low = c(view.x_low), x_high = c(view.x_high), y_low = c(view.y_low), y_high = c(view.y_high);
  p.ratio_x = clamp(x, x_low, x_high);
  p.ratio_y = clamp(y, y_low, y_high);
  p.free_x = select((x >= x_low) & (x <= x_high), c(1), c(0));
  p.free_y = select((y >= y_low) & (y <= y_high), c(1), c(0));

  const V jx = view.fx * p.inverse_z, jy = view.fy * p.inverse_z;
  for (int j = 0; j < 3; ++j) {
    p.jr0[j] = jx * (view.rotation[j] - p.ratio_x * view.rotation[6 + j]);
    p.jr1[j] = jy * (view.rotation[3 + j] - p.ratio_y * view.rotation[6 + j]);
  }

  const V eps = c(eps2d);
  V c00, c01, c11;
  if constexpr (kCov3d) {
    const V* s = g.cov;
    for (int k = 0; k < 2; ++k) {
      const V* a = k == 0 ? p.jr0 : p.jr1;
      V* row = k == 0 ? p.row0 : p.row1;
      row[0] = a[0] * s[0] + a[1] * s[1] + a[2] * s[2];
      row[1] = a[0] * s[1] + a[1] * s[3] + a[2] * s[4];
      row[2] = a[0] * s[2] + a[1] * s[4] + a[2] * s[5];
    }
    c00 = dot3(p.row0, p.jr0);
    c01 = dot3(p.row0, p.jr1);
    c11 = dot3(p.row1, p.jr1);
    p.det0 = c00 * c11 - c01 * c01;
    p.c00 = c00 + eps, p.c01 = c01, p.c11 = c11 + eps;
    p.det = p.c00 * p.c11 - c01 * c01;
  } else {
    p.inverse_norm = rotation_of(g.quat, p.quat, p.rotation);
    const V* m = p.rotation;
    for (int k = 0; k < 3; ++k) {
      const V s = scale_modifier * g.scale[k];
      p.row0[k] = s * (p.jr0[0] * m[k] + p.jr0[1] * m[3 + k] + p.jr0[2] * m[6 + k]);
      p.row1[k] = s * (p.jr1[0] * m[k] + p.jr1[1] * m[3 + k] + p.jr1[2] * m[6 + k]);
    }
    c00 = dot3(p.row0, p.row0);
    c01 = dot3(p.row0, p.row1);
    c11 = dot3(p.row1, p.row1);
    const V n0 = p.row0[1] * p.row1[2] - p.row0[2] * p.row1[1];
    const V n1 = p.row0[2] * p.row1[0] - p.row0[0] * p.row1[2];
    const V n2 = p.row0[0] * p.row1[1] - p.row0[1] * p.row1[0];
    p.det0 = n0 * n0 + n1 * n1 + n2 * n2;
    p.c00 = c00 + eps, p.c01 = c01, p.c11 = c11 + eps;
    p.det = p.det0 + eps * (c00 + c11) + eps * eps;
  }
  const V inverse_det = c(1) / p.det;
  p.ka = p.c11 * inverse_det;
  p.kb = -c01 * inverse_det;
  p.kc = p.c00 * inverse_det;
  p.rho = antialias ? square_root(maximum(c(kCompensationMin), p.det0 * inverse_det)) : c(1);
}

// Bounding radius in pixels, an integer: ceil(3 sqrt(largest eigenvalue)), with the floor that 3DGS puts under the
// root.
template <class V>
SW_HD V bounding_radius(const Projection<V>& p) {
  const auto c = [](double value) { return constant<V>(value); };
  const V mid = c(0.5) * (p.c00 + p.c11), half_gap = c(0.5) * (p.c00 - p.c11);
  const V spread = square_root(maximum(c(kLambdaFloor), half_gap * half_gap + p.c01 * p.c01));
  return round_up(c(kRadiusSigma) * square_root(mid + spread));
}

template <class V>
struct ScreenGradient {  // what the blend stage hands back
  V u, v;                // dL/d pixel position
  V ka, kb, kc;          // dL/d conic (kb: of the shared entry)
  V opacity;             // dL/d(effective opacity)
  V depth;               // dL/d tz from depth outputs
};

template <class V>
struct GeometryGradient {
  V mean[3];
  V scale[3], quat[4];
  V cov[6];
  V opacity;
};

template <bool kCov3d, class V>
SW_HD void project_backward(const View<Scalar<V>>& view, Scalar<V> scale_modifier, Scalar<V> eps2d, bool antialias,
                            bool original_clamp, const Geometry<V>& g, const Projection<V>& p, V opacity,
                            const ScreenGradient<V>& grad, GeometryGradient<V>& out) {
  const auto c = [](double value) { return constant<V>(value); };
  const V half = c(0.5), two = c(2);

  // Gc = -K GK K, symmetric: g00, g01, g11.
  const V gb = half * grad.kb;
  const V x00 = grad.ka * p.ka + gb * p.kb, x01 = grad.ka * p.kb + gb * p.kc;
  const V x10 = gb * p.ka + grad.kc * p.kb, x11 = gb * p.kb + grad.kc * p.kc;
  V g00 = -(p.ka * x00 + p.kb * x10), g01 = -(p.ka * x01 + p.kb * x11), g11 = -(p.kb * x01 + p.kc * x11);

  out.opacity = p.rho * grad.opacity;
  if (antialias) {
    const V det_conic = c(1) / p.det;
    const V active = select(p.det0 * det_conic > c(kCompensationMin), c(1), c(0));
    const V factor = active * opacity * grad.opacity * half / p.rho;
    const V shrink = c(1) - p.rho * p.rho, shift = eps2d * det_conic;
    g00 += factor * (shrink * p.ka - shift);
    g01 += factor * shrink * p.kb;
    g11 += factor * (shrink * p.kc - shift);
  }

  V ga0[3], ga1[3];  // dL/dA, rows
  if constexpr (kCov3d) {
    for (int j = 0; j < 3; ++j) {
      ga0[j] = two * (g00 * p.row0[j] + g01 * p.row1[j]);
      ga1[j] = two * (g01 * p.row0[j] + g11 * p.row1[j]);
    }
    // GS = A^T Gc A; off-diagonal entries appear twice in S.
    V w0[3], w1[3];
    for (int j = 0; j < 3; ++j) {
      w0[j] = g00 * p.jr0[j] + g01 * p.jr1[j];
      w1[j] = g01 * p.jr0[j] + g11 * p.jr1[j];
    }
    int slot = 0;
    for (int i = 0; i < 3; ++i)
      for (int j = i; j < 3; ++j, ++slot) {
        const V value = p.jr0[i] * w0[j] + p.jr1[i] * w1[j];
        out.cov[slot] = i == j ? value : two * value;
      }
  } else {
    V gp0[3], gp1[3];  // dL/dP, rows
    for (int k = 0; k < 3; ++k) {
      gp0[k] = two * (g00 * p.row0[k] + g01 * p.row1[k]);
      gp1[k] = two * (g01 * p.row0[k] + g11 * p.row1[k]);
    }
    V gr[9];  // dL/dRq
    for (int j = 0; j < 3; ++j) ga0[j] = ga1[j] = c(0);
    for (int k = 0; k < 3; ++k) {
      const V s = scale_modifier * g.scale[k];
      V along = c(0);
      for (int j = 0; j < 3; ++j) {
        const V gm = p.jr0[j] * gp0[k] + p.jr1[j] * gp1[k];  // dL/dM_jk, M = Rq diag(m s)
        along += gm * p.rotation[3 * j + k];
        gr[3 * j + k] = gm * s;
        const V m = p.rotation[3 * j + k] * s;
        ga0[j] += gp0[k] * m;
        ga1[j] += gp1[k] * m;
      }
      out.scale[k] = scale_modifier * along;
    }
    rotation_backward(p.quat, p.inverse_norm, gr, out.quat);
  }

  // GJ = GA R^T; only J00, J02, J11, J12 depend on t.
  const auto& R = view.rotation;
  const V j00 = ga0[0] * R[0] + ga0[1] * R[1] + ga0[2] * R[2], j02 = ga0[0] * R[6] + ga0[1] * R[7] + ga0[2] * R[8];
  const V j11 = ga1[0] * R[3] + ga1[1] * R[4] + ga1[2] * R[5], j12 = ga1[0] * R[6] + ga1[1] * R[7] + ga1[2] * R[8];
  const V iz = p.inverse_z, iz2 = iz * iz;
  V gt[3];
  gt[0] = view.fx * grad.u * iz - p.free_x * (view.fx * j02 * iz2);
  gt[1] = view.fy * grad.v * iz - p.free_y * (view.fy * j12 * iz2);
  // A clamped ratio a is a constant in J02 = -fx a/tz: the coefficient is 1 there, 2 where a = tx/tz. The original
  // kernels take 2 in both cases, which is not the derivative; profile "dgr-exact" asks for that.
  const V factor_x = original_clamp ? two : c(1) + p.free_x, factor_y = original_clamp ? two : c(1) + p.free_y;
  gt[2] = -(view.fx * p.t[0] * grad.u + view.fy * p.t[1] * grad.v) * iz2 - (view.fx * j00 + view.fy * j11) * iz2 +
          factor_x * (view.fx * p.ratio_x * j02 * iz2) + factor_y * (view.fy * p.ratio_y * j12 * iz2) + grad.depth;
  for (int j = 0; j < 3; ++j) out.mean[j] = R[j] * gt[0] + R[3 + j] * gt[1] + R[6 + j] * gt[2];
}

}  // namespace sw
