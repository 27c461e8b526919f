// A surfel (2DGS: a Gaussian on a plane) on the screen, what one pixel makes of it, and the derivatives of both.
//
// With the axes r1, r2 and the centre t in the camera frame, T = K [s1 r1, s2 r2, t] (rows Tu, Tv, Tw) takes the plane
// point (a, b, 1) to a homogeneous pixel. The ray of pixel (x, y) meets the plane at s = (p.x, p.y) / p.z,
// p = (x Tw - Tu) x (y Tw - Tv), at depth z = s . (Tw.x, Tw.y) + Tw.z.
//
// p is affine in x and y. Written about the projected centre (u0, v0), dx = x - u0, with Tu' = Tu - u0 Tw (so that
// Tu'.z = Tv'.z = 0, and nothing large cancels) and divided by lambda = p.z at the centre:
//     n1 = A dx + B dy,  n2 = C dx + D dy,  w = 1 + E dx + F dy;    s = (n1, n2) / w,   z = tz / w.
// Scales divide (A, B) and (C, D) and touch nothing else: neither z nor its derivative knows how small they are.
// Backward, the nine moments sum dL/d(n1, n2, w) x (1, dx, dy) are dL/dp's; T follows by cross products.
//
// The extent is that of the circle of radius 3: with q = (9, 9, -1) and f = q / (q . Tw o Tw), centre f . Tu' o Tw from
// (u0, v0), half extents squared centre^2 - f . Tu' o Tu'. Around that centre lies the low-pass of sqrt(1/2) px.
#pragma once

#include "camera.h"
#include "rotation.h"

namespace sw {

constexpr double kSurfelLevel = 9.0;             // squared radius of the extent, standard deviations
constexpr double kSurfelDot = 0.5;               // variance of the low-pass, px^2
constexpr double kSurfelMinExtent = 1e-4;        // floor of the squared half extents, px^2
constexpr double kSurfelMinRadius = 2.12132034;  // 3 sqrt(1/2)
constexpr double kDistortionNear = 0.2, kDistortionFar = 100.0;
// (m_i - m_j)^2 = kDistortionScale (1/z_i - 1/z_j)^2 with m = far/(far - near) (1 - near/z).
constexpr double kDistortionSlope = kDistortionFar * kDistortionNear / (kDistortionFar - kDistortionNear);
constexpr double kDistortionScale = kDistortionSlope * kDistortionSlope;

template <class V>
struct SurfelGeometry {
  V mean[3], scale[2], quat[4];
};

template <class V>
struct SurfelProjection {
  V t[3], ratio_x, ratio_y;  // centre in the camera frame, tx/tz, ty/tz
  V u0, v0;                  // its pixel
  V unit[4], inverse_norm;   // quaternion
  V axes[9];                 // R Rq: column k is axis k in the camera frame
  V sign;                    // of axis 3 towards the camera
  V facing;                  // axis 3 . t
  V scale[2];                // with the modifier
  V tu[2], tv[2], tw[2];     // Tu', Tv', Tw without scales; their third entries are 0, 0, tz
  V lambda;                  // of the unscaled plane
  V a, b, c, d, e, f;
  V center_x, center_y;  // of the extent, from (u0, v0)
  V extent_x, extent_y;  // half extents squared
  V denominator;         // q . Tw o Tw
};

// Picture of the circle of squared radius `level`: k = level / -denominator is positive where it ends.
template <class V>
struct SurfelOutline {
  V denominator, k;
  V x, y;  // centre, from (u0, v0)
};

template <class V>
SW_HD SurfelOutline<V> surfel_outline(const SurfelProjection<V>& p, V level) {
  const V e = p.scale[0] * p.tw[0], f = p.scale[1] * p.tw[1];
  SurfelOutline<V> o;
  o.denominator = level * (e * e + f * f) - p.t[2] * p.t[2];
  o.k = -level / o.denominator;
  o.x = -o.k * (p.scale[0] * p.tu[0] * e + p.scale[1] * p.tu[1] * f);
  o.y = -o.k * (p.scale[0] * p.tv[0] * e + p.scale[1] * p.tv[1] * f);
  return o;
}

template <class V>
SW_HD void project_surfel(const View<Scalar<V>>& view, Scalar<V> scale_modifier, const SurfelGeometry<V>& g,
                          SurfelProjection<V>& p) {
  const auto c = [](double value) { return constant<V>(value); };
  const auto& R = view.rotation;
  for (int i = 0; i < 3; ++i)
    p.t[i] = R[3 * i] * g.mean[0] + R[3 * i + 1] * g.mean[1] + R[3 * i + 2] * g.mean[2] + view.translation[i];
  const V inverse_z = c(1) / p.t[2];
  p.ratio_x = p.t[0] * inverse_z, p.ratio_y = p.t[1] * inverse_z;
  p.u0 = view.fx * p.ratio_x + view.cx;
  p.v0 = view.fy * p.ratio_y + view.cy;

  V m[9];
  p.inverse_norm = rotation_of(g.quat, p.unit, m);
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k)
      p.axes[3 * i + k] = R[3 * i] * m[k] + R[3 * i + 1] * m[3 + k] + R[3 * i + 2] * m[6 + k];
  p.facing = p.axes[2] * p.t[0] + p.axes[5] * p.t[1] + p.axes[8] * p.t[2];
  p.sign = select(p.facing > c(0), c(-1), c(1));

  for (int k = 0; k < 2; ++k) {
    p.scale[k] = scale_modifier * g.scale[k];
    p.tu[k] = view.fx * (p.axes[k] - p.ratio_x * p.axes[6 + k]);
    p.tv[k] = view.fy * (p.axes[3 + k] - p.ratio_y * p.axes[6 + k]);
    p.tw[k] = p.axes[6 + k];
  }
  p.lambda = p.tu[0] * p.tv[1] - p.tu[1] * p.tv[0];
  const V inverse = c(1) / p.lambda;
  const V along = p.t[2] * inverse / p.scale[0], across = p.t[2] * inverse / p.scale[1];
  p.a = along * p.tv[1], p.b = -along * p.tu[1];
  p.c = -across * p.tv[0], p.d = across * p.tu[0];
  p.e = inverse * (p.tv[0] * p.tw[1] - p.tv[1] * p.tw[0]);
  p.f = inverse * (p.tw[0] * p.tu[1] - p.tw[1] * p.tu[0]);

  const SurfelOutline<V> o = surfel_outline(p, c(kSurfelLevel));
  p.denominator = o.denominator;
  p.center_x = o.x, p.center_y = o.y;
  const V s0 = p.scale[0] * p.scale[0], s1 = p.scale[1] * p.scale[1];
  p.extent_x = o.x * o.x + o.k * (s0 * p.tu[0] * p.tu[0] + s1 * p.tu[1] * p.tu[1]);
  p.extent_y = o.y * o.y + o.k * (s0 * p.tv[0] * p.tv[0] + s1 * p.tv[1] * p.tv[1]);
}

// Bounding radius in pixels, an integer.
template <class V>
SW_HD V surfel_radius(const SurfelProjection<V>& p) {
  const auto c = [](double value) { return constant<V>(value); };
  const V largest = square_root(maximum(maximum(p.extent_x, p.extent_y), c(kSurfelMinExtent)));
  return round_up(maximum(largest, c(kSurfelMinRadius)));
}

// An ellipse that holds every pixel with rho <= level: its centre in pixels, its covariance per unit of `level`, and
// the inverse of that.
template <class V>
struct SurfelBound {
  V u, v;
  V c00, c01, c11;
  V ka, kb, kc;
};

// Where a plane comes nearer than `near` its picture may have no end. What is drawn of the circle then is the part
// beyond z = near, a convex piece: its lowest and highest u lie at the ends of the cut or where the circle touches a
// line of constant u. `axis`: Tu' or Tv', tw: Tw, with scales; middle, squared: the outline's; low, high: from the
// projected centre, as those.
template <class V>
SW_HD void cut_circle_span(const V* axis, const V* tw, V tz, V level, V near, V middle, V squared, V* low, V* high) {
  const V zero = constant<V>(0), tiny = constant<V>(1e-30);
  const V slope = maximum(tw[0] * tw[0] + tw[1] * tw[1], tiny), foot = (near - tz) / slope;
  const V half = square_root(maximum(level / slope - foot * foot, zero));
  const V at_foot = foot * (axis[0] * tw[0] + axis[1] * tw[1]), along = half * (axis[1] * tw[0] - axis[0] * tw[1]);
  const V first = (at_foot + along) / near, second = (at_foot - along) / near;
  *low = minimum(first, second), *high = maximum(first, second);
  const V extent = square_root(maximum(squared, zero));
  for (int side = 0; side < 2; ++side) {
    const V u = side == 0 ? middle + extent : middle - extent;
    const V x = axis[0] - u * tw[0], y = axis[1] - u * tw[1];
    const V t = u * tz / maximum(x * x + y * y, tiny);  // the circle is touched at t (x, y)
    const auto drawn = (squared >= zero) & (tz + t * (x * tw[0] + y * tw[1]) >= near);
    *low = select(drawn, minimum(*low, u), *low);
    *high = select(drawn, maximum(*high, u), *high);
  }
}

template <class V>
SW_HD SurfelBound<V> surfel_bound(const View<Scalar<V>>& view, const SurfelProjection<V>& p, V level) {
  const auto c = [](double value) { return constant<V>(value); };
  const V zero = c(0), half = c(0.5), scale = c(1) / level;
  const SurfelOutline<V> o = surfel_outline(p, level);
  const V xs[2] = {p.scale[0] * p.tu[0], p.scale[1] * p.tu[1]};
  const V ys[2] = {p.scale[0] * p.tv[0], p.scale[1] * p.tv[1]};
  // The outline's covariance and its determinant are sums of squares: needles keep their shape.
  const V root = square_root(maximum(o.k, zero));
  const V x[3] = {o.x, root * xs[0], root * xs[1]}, y[3] = {o.y, root * ys[0], root * ys[1]};
  const V n0 = x[1] * y[2] - x[2] * y[1], n1 = x[2] * y[0] - x[0] * y[2], n2 = x[0] * y[1] - x[1] * y[0];
  const V xx = scale * dot3(x, x), yy = scale * dot3(y, y), xy = scale * dot3(x, y);
  const V det = scale * scale * (n0 * n0 + n1 * n1 + n2 * n2);
  // Both axes are long enough to hold the low-pass around its own centre.
  const V dot = square_root(c(kSurfelDot) * level), off_x = p.center_x - o.x, off_y = p.center_y - o.y;
  const V reach = dot + square_root(off_x * off_x + off_y * off_y), least = reach * reach * scale;
  const V mid = half * (xx + yy), gap = half * (xx - yy), spread = square_root(gap * gap + xy * xy);
  const V longer = maximum(mid + spread, least);
  const V shorter = maximum(det / maximum(mid + spread, c(1e-30)), least);
  const V turn = half * (longer - shorter) / maximum(spread, c(1e-30)), level_mid = half * (longer + shorter);
  SurfelBound<V> bound;
  bound.u = p.u0 + o.x, bound.v = p.v0 + o.y;
  bound.c00 = level_mid + turn * gap, bound.c11 = level_mid - turn * gap, bound.c01 = turn * xy;
  V inverse = c(1) / (longer * shorter);

  // No end, or one that is too far away: the box of what lies in front of the camera, and the ellipse around that.
  const auto endless = (o.denominator >= zero) | (longer >= c(1e12));
  if (any(endless)) {
    const V near = c(view.near);
    const V extent_x = o.x * o.x + o.k * (xs[0] * xs[0] + xs[1] * xs[1]);
    const V extent_y = o.y * o.y + o.k * (ys[0] * ys[0] + ys[1] * ys[1]);
    const V tw[2] = {p.scale[0] * p.tw[0], p.scale[1] * p.tw[1]};
    V low_x, high_x, low_y, high_y;
    cut_circle_span(xs, tw, p.t[2], level, near, o.x, extent_x, &low_x, &high_x);
    cut_circle_span(ys, tw, p.t[2], level, near, o.y, extent_y, &low_y, &high_y);
    const auto flat = o.denominator == zero;  // a parabola: tried everywhere
    const auto fit = [&](V low, V high, V origin, V dot_center, int size, V* middle, V* spread_of) {
      const V slack = c(2), first = c(-8), last = c(size + 8.0);
      const V from = clamp(origin + minimum(low, dot_center - dot) - slack, first, last);
      const V to = clamp(origin + maximum(high, dot_center + dot) + slack, first, last);
      const V a = select(flat, first, from), b = select(flat, last, to);
      *middle = select(endless, half * (a + b), *middle);
      *spread_of = select(endless, scale * c(0.5) * (b - a) * (b - a) + scale, *spread_of);  // 2 (half width)^2
    };
    fit(low_x, high_x, p.u0, p.center_x, view.width, &bound.u, &bound.c00);
    fit(low_y, high_y, p.v0, p.center_y, view.height, &bound.v, &bound.c11);
    bound.c01 = select(endless, zero, bound.c01);
    inverse = select(endless, c(1) / (bound.c00 * bound.c11), inverse);
  }
  bound.ka = bound.c11 * inverse, bound.kb = -bound.c01 * inverse, bound.kc = bound.c00 * inverse;
  return bound;
}

// The plane as a pixel sees it: 16 values a splat, one cache line in float32.
// clang-format off
enum PlaneField {
  kPlaneA, kPlaneB, kPlaneC, kPlaneD, kPlaneE, kPlaneF,
  kPlaneU, kPlaneV,              // projected centre
  kPlaneCenterX, kPlaneCenterY,  // centre of the low-pass, from there
  kPlaneZ, kPlaneInverseZ,
  kPlaneNormal,                  // 3, camera frame
  kPlaneFarthest = 15,           // w above which z < near; w below tz / far is not drawn either
  kPlane
};
// clang-format on

// Maps beside the image, [kMaps][H][W]: accumulated depth, inverse depth, normals, distortion, median depth.
enum SurfelMap { kMapDepth, kMapInverse, kMapNormal, kMapDistortion = 5, kMapMedian, kMaps };

// What the backward pass has to know of each pixel beside transmittance and last position, [tiles][kTilePixels] each
// on the CPU, [H][W] on CUDA: 1/z of the first surfel, about which the sums are taken (the distortion does not depend
// on it, and differences of nearly equal depths keep their digits); sum w delta and sum w delta^2 with
// delta = 1/z - first; the median's list position.
template <class S>
struct SurfelPixels {
  S *first, *sum, *square;
  int32_t* median;
};

template <class V, class Mask>
struct SurfelHit {
  V n1, n2, w, inverse_w;
  V low_x, low_y;  // pixel minus centre of the low-pass
  Mask on_plane;   // the plane's distance counts, not the low-pass'
  Mask met;        // the ray meets the plane in front of the camera
  V power;         // log2(opacity G)
};

// `plane`: the fields above; far: 1 / camera's far.
template <class V, class S>
SW_HD auto hit_surfel(const S* plane, S level, S inverse_far, V x, V y) {
  const auto c = [](double value) { return constant<V>(value); };
  using Mask = decltype(x < y);
  SurfelHit<V, Mask> h;
  const V dx = x - plane[kPlaneU], dy = y - plane[kPlaneV];
  h.n1 = plane[kPlaneA] * dx + plane[kPlaneB] * dy;
  h.n2 = plane[kPlaneC] * dx + plane[kPlaneD] * dy;
  h.w = (plane[kPlaneE] * dx + plane[kPlaneF] * dy) + S(1);
  h.met = (h.w <= V{} + plane[kPlaneFarthest]) & (h.w >= V{} + plane[kPlaneZ] * inverse_far) & (h.w > c(0));
  h.w = select(h.met, h.w, c(1));  // whatever is computed from it stays finite where it is not used
  h.inverse_w = reciprocal(h.w);
  h.low_x = dx - plane[kPlaneCenterX], h.low_y = dy - plane[kPlaneCenterY];
  const V near_plane = (h.n1 * h.n1 + h.n2 * h.n2) * (h.inverse_w * h.inverse_w);
  const V near_center = (h.low_x * h.low_x + h.low_y * h.low_y) * S(1 / kSurfelDot);
  h.on_plane = near_plane <= near_center;
  h.power = level - S(0.5 * kLog2e) * select(h.on_plane, near_plane, near_center);
  return h;
}

// Whether a pixel of a box around (x, y) may have rho <= level: for large outlines, which an ellipse fits
// badly. Bounds of n1, n2 and w over the box one by one; `dot` is the reach of the low-pass in pixels.
template <class V, class S>
SW_HD auto surfel_meets_box(const S* plane, S level, S dot, V x, V y, S half_x, S half_y) {
  const V zero = constant<V>(0), dx = x - plane[kPlaneU], dy = y - plane[kPlaneV];
  const S wide1 = half_x * absolute(plane[kPlaneA]) + half_y * absolute(plane[kPlaneB]);
  const S wide2 = half_x * absolute(plane[kPlaneC]) + half_y * absolute(plane[kPlaneD]);
  const S wide3 = half_x * absolute(plane[kPlaneE]) + half_y * absolute(plane[kPlaneF]);
  const V n1 = maximum(absolute(plane[kPlaneA] * dx + plane[kPlaneB] * dy) - wide1, zero);
  const V n2 = maximum(absolute(plane[kPlaneC] * dx + plane[kPlaneD] * dy) - wide2, zero);
  const V w = plane[kPlaneE] * dx + plane[kPlaneF] * dy + S(1), most = w + wide3;
  const auto on_plane =
      (most > zero) & (w - wide3 <= V{} + plane[kPlaneFarthest]) & (n1 * n1 + n2 * n2 <= level * most * most);
  const auto at_center = (absolute(dx - plane[kPlaneCenterX]) <= V{} + (half_x + dot)) &
                         (absolute(dy - plane[kPlaneCenterY]) <= V{} + (half_y + dot));
  return on_plane | at_center;
}

// The sums of one (splat, tile) pair over its pixels. The moments are dL/d(n1, n2, w) x (1, dx, dy).
// clang-format off
enum SurfelSum {
  kSumN1, kSumN1x, kSumN1y, kSumN2, kSumN2x, kSumN2y, kSumW, kSumWx, kSumWy,
  kSumLowX, kSumLowY,            // dL/d(centre of the low-pass) / 4
  kSumAlpha,                     // alpha dL/dalpha
  kSumRed, kSumGreen, kSumBlue,
  kSurfelPlain = 16,             // the maps' sums follow
  kSumNormal = 16,               // 3
  kSumZeta = 19,                 // 1/z dL/d(1/z)
  kSurfelColumns = 20
};
// clang-format on

inline int surfel_columns(bool maps) { return maps ? kSurfelColumns : kSurfelPlain; }

template <class V>
struct SurfelGradient {
  V mean[3], scale[2], quat[4], opacity;
  V shift_x, shift_y;  // dL/d(Tu.z, Tv.z) Tw.z: the densification statistic in pixels
};

// out += factor x cross y.
template <class V>
SW_HD void add_cross(V factor, const V* x, const V* y, V* out) {
  out[0] += factor * (x[1] * y[2] - x[2] * y[1]);
  out[1] += factor * (x[2] * y[0] - x[0] * y[2]);
  out[2] += factor * (x[0] * y[1] - x[1] * y[0]);
}

template <class V>
SW_HD void surfel_backward(const View<Scalar<V>>& view, Scalar<V> scale_modifier, const SurfelProjection<V>& p,
                           V opacity, const V* sums, bool maps, SurfelGradient<V>& out) {
  const auto c = [](double value) { return constant<V>(value); };
  const auto& R = view.rotation;
  const V zero = c(0), one = c(1);
  const V inverse_scale[2] = {one / p.scale[0], one / p.scale[1]};
  const V tu[3] = {p.tu[0], p.tu[1], zero}, tv[3] = {p.tv[0], p.tv[1], zero}, tw[3] = {p.tw[0], p.tw[1], p.t[2]};
  V moment[3][3];  // [1, dx, dy][entry of p], of the unscaled plane
  for (int i = 0; i < 3; ++i) {
    moment[i][0] = sums[kSumN1 + i] * inverse_scale[0];
    moment[i][1] = sums[kSumN2 + i] * inverse_scale[1];
    moment[i][2] = sums[kSumW + i];
  }
  const V kappa = maps ? -sums[kSumZeta] / p.t[2] : zero;  // z = det T / p.z: lambda dL/d(det T)

  // p = Tu' x Tv' + dx Tv' x Tw + dy Tw x Tu'.
  const V inverse = one / p.lambda;
  V gu[3] = {zero, zero, zero}, gv[3] = {zero, zero, zero}, gw[3] = {zero, zero, zero};
  add_cross(inverse, tv, moment[0], gu), add_cross(inverse, moment[2], tw, gu), add_cross(inverse * kappa, tv, tw, gu);
  add_cross(inverse, moment[0], tu, gv), add_cross(inverse, tw, moment[1], gv), add_cross(inverse * kappa, tw, tu, gv);
  add_cross(inverse, moment[1], tv, gw), add_cross(inverse, tu, moment[2], gw), add_cross(inverse * kappa, tu, tv, gw);
  V gs[2];
  gs[0] = -inverse_scale[0] * (p.a * sums[kSumN1x] + p.b * sums[kSumN1y]);
  gs[1] = -inverse_scale[1] * (p.c * sums[kSumN2x] + p.d * sums[kSumN2y]);

  // The centre of the low-pass: f . Tu' o Tw with f = q / D, of the scaled plane.
  const V cx = c(4) * sums[kSumLowX], cy = c(4) * sums[kSumLowY];
  const V inverse_d = one / p.denominator, level = c(kSurfelLevel);
  const V q[3] = {level, level, c(-1)};
  const V scale[3] = {p.scale[0], p.scale[1], one};
  V gf_f = zero;
  for (int k = 0; k < 3; ++k)
    gf_f += scale[k] * scale[k] * (cx * tu[k] + cy * tv[k]) * tw[k] * q[k] * inverse_d;
  for (int k = 0; k < 3; ++k) {
    const V f = q[k] * inverse_d, w = scale[k] * tw[k];
    const V du = cx * f * w, dv = cy * f * w;
    const V dw = f * scale[k] * (cx * tu[k] + cy * tv[k]) - c(2) * gf_f * inverse_d * q[k] * w;
    if (k < 2) gs[k] += du * tu[k] + dv * tv[k] + dw * tw[k];
    gu[k] += scale[k] * du, gv[k] += scale[k] * dv, gw[k] += scale[k] * dw;
  }
  out.shift_x = gu[2] * p.t[2], out.shift_y = gv[2] * p.t[2];

  // T = K [r1, r2, t]: back to the camera frame, then to the world.
  V world[3][3];  // gradient of axis 1, axis 2, centre
  for (int k = 0; k < 3; ++k) {
    const V x = view.fx * gu[k], y = view.fy * gv[k], z = gw[k] - x * p.ratio_x - y * p.ratio_y;
    for (int j = 0; j < 3; ++j) world[k][j] = R[j] * x + R[3 + j] * y + R[6 + j] * z;
  }
  V gr[9];
  for (int j = 0; j < 3; ++j) {
    out.mean[j] = world[2][j];
    gr[3 * j] = world[0][j], gr[3 * j + 1] = world[1][j];
    gr[3 * j + 2] = maps ? p.sign * (R[j] * sums[kSumNormal] + R[3 + j] * sums[kSumNormal + 1] +
                                     R[6 + j] * sums[kSumNormal + 2])
                         : zero;
  }
  rotation_backward(p.unit, p.inverse_norm, gr, out.quat);
  for (int k = 0; k < 2; ++k) out.scale[k] = scale_modifier * gs[k];
  out.opacity = sums[kSumAlpha] / opacity;
}

}  // namespace sw
