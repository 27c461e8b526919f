// Vectors of float64 that hold integers: sums of products below 2^53 are exact, in any order, with or without
// multiply-add.
#pragma once
#include <cstdint>

namespace SW_ARCH {

#ifdef __AVX512F__
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif

typedef double Vec __attribute__((vector_size(8 * LANES)));
typedef int64_t IntVec __attribute__((vector_size(8 * LANES)));
typedef double VecLoad __attribute__((vector_size(8 * LANES), aligned(8)));
typedef int32_t Narrow __attribute__((vector_size(4 * LANES)));
typedef int32_t NarrowLoad __attribute__((vector_size(4 * LANES), aligned(4)));
typedef float FloatLoad __attribute__((vector_size(4 * LANES), aligned(4)));
typedef int64_t IntLoad __attribute__((vector_size(8 * LANES), aligned(8)));

// Not `Vec{} + x`: that adds, for the sake of -0.
#ifdef __AVX512F__
inline Vec all(double x) { return Vec{x, x, x, x, x, x, x, x}; }
#else
inline Vec all(double x) { return Vec{x, x, x, x}; }
#endif
inline Vec load(const double* p) { return *reinterpret_cast<const VecLoad*>(p); }
inline void store(double* p, Vec v) { *reinterpret_cast<VecLoad*>(p) = v; }
inline void store_narrow(int32_t* p, Narrow v) { *reinterpret_cast<NarrowLoad*>(p) = v; }

constexpr double ROUND = 6755399441055744.0;  // 1.5 * 2^52: a sum with it has no fraction

// The largest integer up to x, |x| < 2^51.
inline Vec floor_of(Vec x) {
  const Vec near = (x + ROUND) - ROUND;
  return near - reinterpret_cast<Vec>((near > x) & reinterpret_cast<IntVec>(all(1.0)));
}

// Integers below 2^51 as int64.
inline void store_integers(int64_t* p, Vec x) {
  *reinterpret_cast<IntLoad*>(p) = reinterpret_cast<IntVec>(x + ROUND) - reinterpret_cast<IntVec>(all(ROUND));
}

// The same the other way: |x| < 2^51.
inline Vec of_integers(IntVec x) {
  return reinterpret_cast<Vec>(x + reinterpret_cast<IntVec>(all(ROUND))) - ROUND;
}

inline Vec clamped(Vec x, double low, double high) {
  x = x < all(low) ? all(low) : x;
  return x > all(high) ? all(high) : x;
}

constexpr double ACTIVATION_LIMIT = 1 << 20;

// A layer's sum as its output: 12 of 24 fractional bits go.
inline Vec shifted(Vec sum) { return floor_of(sum * (1.0 / 4096)); }

}  // namespace SW_ARCH
