// Sums over pixels that say how much a Gaussian matters: what is added up per pixel, and how the Fisher block of a
// Gaussian is put together from such sums. The same for the CPU and the CUDA kernels.
//
// Over the pairs of a pixel and a splat that is blended there (rule "tested": also where it stops the pixel), o the
// effective opacity, T the transmittance in front:
//   hits 1, opacity o, opacity_T o T, blend alpha T, blend_max its maximum, blend_sq its square, shown 1 where
//   alpha T > 1/255, gamma alpha^(2g) T^(2-2g), dist |d|,
//   grad_sq (o dL/dalpha)^2 for L = sum of all pixels and channels (Speedy-Splat, arXiv 2412.00578)
// each times the pixel's weight, if there is one. The constant factor o is multiplied in at the end. And
//   removal  sum over channels of d (d + 2 r), d = -alpha d image_c / d alpha, r = image_c less the picture: what the
//            squared error changes by if the splat is not drawn, since the image is affine in each alpha
//
// Fisher block of theta = (mean, log scale), F = sum over pixels and channels of g g^T, g = d image_c / d theta
// (PUP 3D-GS, arXiv 2406.10219), factorised: with v_c = d image_c / d sigma, w = alpha T and
// m = (dx, dy, dx^2, dx dy, dy^2), g = B m v_c + w jc_c, where B = (d sigma / d theta per entry of m) and
// jc_c = d colour_c / d theta. So per splat 28 sums are enough and
//   F = B Q B^T + sum_c (B X_c jc_c^T + jc_c (B X_c)^T + Z jc_c jc_c^T).
#pragma once

#include "projection.h"

namespace sw {

// Mirrored in scoring.py. Those from kGradSq on depend on the light behind a splat.
enum ScoreKind {
  kHits, kOpacity, kOpacityT, kBlend, kBlendMax, kGamma, kDist, kBlendSq, kShown, kGradSq, kRemoval
};

constexpr int kMaxScores = 32;  // of one call; a lane of a warp each
constexpr double kShownMin = 1.0 / 255;
SW_HD constexpr bool is_sensitive(int kind) { return kind >= kGradSq; }

template <class S>
struct Score {
  int kind;
  bool tested;      // rule
  S gamma;          //
  const S* weight;  // [H][W], of kRemoval the residual [3][H][W], or null
};

template <class S>
struct Scores {
  int count = 0;
  Score<S> of[kMaxScores];
};

// What the removal of a splat adds to one pixel's squared error; `slope` [3] d image_c / d alpha, `residual` [3].
template <class V>
SW_HD V removal_change(V alpha, const V* slope, const V* residual) {
  V sum = constant<V>(0);
  for (int c = 0; c < 3; ++c) {
    const V change = -(alpha * slope[c]);
    sum += change * (change + residual[c] + residual[c]);
  }
  return sum;
}

// The sums behind a Fisher block: Q's 12 distinct moments dx^i dy^j of sum_c v_c^2, by degree and then by falling i;
// then sum v_c w m for each channel; then sum w^2.
constexpr int kMoments4 = 12, kPositions = 5, kFisherSums = kMoments4 + 3 * kPositions + 1;
constexpr int kTheta = 6, kFisher = kTheta * (kTheta + 1) / 2;  // upper triangle, row by row

// Which moment stands at (i, j) of Q = sum (sum_c v_c^2) m m^T.
SW_HD constexpr int moment_at(int i, int j) {
  constexpr int power_x[kPositions] = {1, 0, 2, 1, 0}, power_y[kPositions] = {0, 1, 0, 1, 2};
  const int y = power_y[i] + power_y[j], degree = power_x[i] + power_x[j] + y;
  return (degree == 2 ? 0 : degree == 3 ? 3 : 7) + y;
}

// Adds one pixel's part. `sums` [kFisherSums]; `v` [3] d image_c / d sigma.
template <class V>
SW_HD void add_fisher_pixel(V dx, V dy, const V* v, V weight, V* sums) {
  const V square = v[0] * v[0] + v[1] * v[1] + v[2] * v[2];
  const V xx = dx * dx, xy = dx * dy, yy = dy * dy;
  const V m[kPositions] = {dx, dy, xx, xy, yy};
  const V qxx = square * xx, qxy = square * xy, qyy = square * yy;
  sums[0] += qxx, sums[1] += qxy, sums[2] += qyy;
  sums[3] += qxx * dx, sums[4] += qxx * dy, sums[5] += qyy * dx, sums[6] += qyy * dy;
  sums[7] += qxx * xx, sums[8] += qxx * xy, sums[9] += qxx * yy, sums[10] += qyy * xy, sums[11] += qyy * yy;
  for (int c = 0; c < 3; ++c) {
    const V vw = v[c] * weight;
    for (int i = 0; i < kPositions; ++i) sums[kMoments4 + kPositions * c + i] += vw * m[i];
  }
  sums[kFisherSums - 1] += weight * weight;
}

// B [kTheta][kPositions]: how sigma's coefficients of m change with the mean and the log scales.
template <class V>
SW_HD void fisher_basis(const View<Scalar<V>>& view, const Geometry<V>& in, Scalar<V> scale_modifier, Scalar<V> eps2d,
                        bool original_clamp, V (*basis)[kPositions]) {
  const V zero = constant<V>(0), one = constant<V>(1), half = constant<V>(0.5);
  Projection<V> p;
  project<false>(view, scale_modifier, eps2d, false, in, p);
#if defined(__CUDA_ARCH__)
#pragma unroll 1
#endif
  for (int i = 0; i < kPositions; ++i) {
    // Coefficient i of sigma as a combination of u, v and the conic's entries.
    ScreenGradient<V> grad{zero, zero, zero, zero, zero, zero, zero};
    if (i == 0) grad.u = p.ka, grad.v = p.kb;
    if (i == 1) grad.u = p.kb, grad.v = p.kc;
    if (i == 2) grad.ka = half;
    if (i == 3) grad.kb = one;
    if (i == 4) grad.kc = half;
    GeometryGradient<V> slope;
    project_backward<false>(view, scale_modifier, eps2d, false, original_clamp, in, p, one, grad, slope);
    for (int j = 0; j < 3; ++j) {
      basis[j][i] = slope.mean[j];
      basis[3 + j][i] = slope.scale[j] * in.scale[j];
    }
  }
}

// F to `out` [kFisher], from B, the sums, and `color` [3][3]: d colour_c / d mean, zero where the channel is clamped.
// D is double, or a pack of them.
template <class D>
SW_HD void fisher_block(const D (*basis)[kPositions], const D* sums, const D* color, D* out) {
  const D* cross = sums + kMoments4;
  const D squared_weight = sums[kFisherSums - 1];
  D along[3][kTheta];  // B X_c
  for (int c = 0; c < 3; ++c)
    for (int a = 0; a < kTheta; ++a) {
      along[c][a] = basis[a][0] * cross[kPositions * c];
      for (int i = 1; i < kPositions; ++i) along[c][a] += basis[a][i] * cross[kPositions * c + i];
    }
  int slot = 0;
  for (int a = 0; a < kTheta; ++a) {
    D left[kPositions];  // row a of B Q
    for (int j = 0; j < kPositions; ++j) {
      left[j] = basis[a][0] * sums[moment_at(0, j)];
      for (int i = 1; i < kPositions; ++i) left[j] += basis[a][i] * sums[moment_at(i, j)];
    }
    for (int b = a; b < kTheta; ++b, ++slot) {
      D value = left[0] * basis[b][0];
      for (int j = 1; j < kPositions; ++j) value += left[j] * basis[b][j];
      for (int c = 0; c < 3; ++c) {  // colours change with the mean only
        if (a < 3) value += color[3 * c + a] * along[c][b];
        if (b < 3) value += color[3 * c + b] * (along[c][a] + squared_weight * color[3 * c + a]);
      }
      out[slot] = value;
    }
  }
}

}  // namespace sw
