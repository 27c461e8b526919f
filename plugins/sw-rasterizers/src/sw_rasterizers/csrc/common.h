// What every kernel of the family shares: the host/device macro, the constants of the 3DGS rasterizer, and the
// few scalar operations that the shared mathematics is written in.
//
// The mathematics (projection.h, sh.h, tiles.h, blend.h) is templated on a value type V. On the CPU V is a pack of
// 16, 8 or 4 floats (cpu/simd.h), a double, or a float; on CUDA it is the float of one thread. The headers use only
// arithmetic, comparisons and the functions declared here, so that one text serves all of them.
#pragma once

#include <cmath>
#include <cstdint>

#if defined(__CUDACC__)
#define SW_HD __host__ __device__ __forceinline__
#else
#define SW_HD inline __attribute__((always_inline))
#endif

namespace sw {

// Constants of profile "3dgs".
constexpr int kTile = 16;                    // pixels, tile edge
constexpr int kTilePixels = kTile * kTile;   //
constexpr double kAlphaMin = 1.0 / 255.0;    // contributions below are skipped
constexpr double kAlphaMax = 0.99;           // alpha is clamped here
constexpr double kTransmittanceMin = 1e-4;   // a pixel is finished below
constexpr double kJacobianClamp = 0.3;       // tx/tz is clamped 0.3 tan(fov/2) outside the image
constexpr double kRadiusSigma = 3.0;         // bounding radius in standard deviations
constexpr double kLambdaFloor = 0.1;         // under the root of the radius
constexpr double kCompensationMin = 2.5e-5;  // floor of the antialias factor, squared
constexpr double kLog2e = 1.4426950408889634;
constexpr double kLn2 = 0.6931471805599453;
constexpr double kLog2AlphaMin = -7.994353436858858;  // log2(1/255)

// The element type of a value type; packs specialise it.
template <class V>
struct ScalarOf {
  using type = V;
};
template <class V>
using Scalar = typename ScalarOf<V>::type;

// A constant as V; packs overload it through their own `broadcast`.
template <class V>
SW_HD V constant(double value) {
  return V{} + static_cast<Scalar<V>>(value);
}

}  // namespace sw

#if !defined(__CUDACC__)
#include "cpu/simd.h"  // packs; overloads must be known before the templates that use them
#endif

namespace sw {

template <class T>
SW_HD T select(bool condition, T yes, T no) {
  return condition ? yes : no;
}
SW_HD bool any(bool condition) { return condition; }
SW_HD float square_root(float x) { return sqrtf(x); }
SW_HD double square_root(double x) { return sqrt(x); }
SW_HD float round_up(float x) { return ceilf(x); }
SW_HD double round_up(double x) { return ceil(x); }
SW_HD float round_down(float x) { return floorf(x); }
SW_HD double round_down(double x) { return floor(x); }
SW_HD float log_2(float x) { return log2f(x); }
SW_HD double log_2(double x) { return log2(x); }
SW_HD float absolute(float x) { return fabsf(x); }
SW_HD double absolute(double x) { return fabs(x); }

template <class V>
SW_HD V minimum(V a, V b) {
  return select(a < b, a, b);
}
template <class V>
SW_HD V maximum(V a, V b) {
  return select(a > b, a, b);
}
template <class V>
SW_HD V clamp(V x, V low, V high) {
  return minimum(maximum(x, low), high);
}

// The smaller of the two; NaN if x is.
template <class V>
SW_HD V at_most(V x, V limit) {
  return select(limit < x, limit, x);
}
template <class V>
SW_HD V reciprocal(V x) {
  return constant<V>(1) / x;
}
#if defined(__CUDA_ARCH__)
#if __CUDA_ARCH__ >= 800
SW_HD float at_most(float x, float limit) {  // one instruction; fminf would drop a NaN
  float y;
  asm("min.NaN.f32 %0, %1, %2;" : "=f"(y) : "f"(x), "f"(limit));
  return y;
}
#endif
SW_HD float reciprocal(float x) {  // within 1 ulp; the exact division takes ten instructions
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
#endif

// 0 for finite x, NaN otherwise: sums of it test many values at once.
template <class V>
SW_HD V finite_probe(V x) {
  return x * constant<V>(0);
}

}  // namespace sw
