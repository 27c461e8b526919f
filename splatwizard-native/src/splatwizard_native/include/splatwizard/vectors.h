// Vectors of float32 of the widest registers there are, and products of small matrices with their sums in registers.
#pragma once

#include <cstdint>
#include <cstring>
#include <initializer_list>

namespace SW_ARCH {

#if defined(__AVX512F__)
constexpr int LANES = 16, ROWS = 12;
#elif defined(__AVX__)
constexpr int LANES = 8, ROWS = 6;
#else
constexpr int LANES = 4, ROWS = 6;
#endif
constexpr int WIDE = 2, TILE = WIDE * LANES;  // a product has sums of ROWS rows and TILE columns in registers

typedef float Vec __attribute__((vector_size(4 * LANES)));
typedef int32_t IntVec __attribute__((vector_size(4 * LANES)));
typedef float VecLoad __attribute__((vector_size(4 * LANES), aligned(4)));

inline Vec load(const float* p) { return *reinterpret_cast<const VecLoad*>(p); }
inline void store(float* p, Vec v) { *reinterpret_cast<VecLoad*>(p) = v; }
// Written out: from a loop GCC makes no broadcast.
#if defined(__AVX512F__)
inline Vec all(float x) { return Vec{x, x, x, x, x, x, x, x, x, x, x, x, x, x, x, x}; }
#elif defined(__AVX__)
inline Vec all(float x) { return Vec{x, x, x, x, x, x, x, x}; }
#else
inline Vec all(float x) { return Vec{x, x, x, x}; }
#endif

inline int64_t padded(int64_t count, int64_t unit) { return (count + unit - 1) / unit * unit; }

#ifdef __clang__
#define SW_SHUFFLED(a, b, ...) __builtin_shufflevector(a, b, __VA_ARGS__)
#else
#define SW_SHUFFLED(a, b, ...) __builtin_shuffle(a, b, Places{__VA_ARGS__})
#endif

// Sums of the lanes of each of N <= 8 vectors.
template <int N>
inline void lane_sums(const Vec (&of)[N], float* to) {
#if defined(__AVX__)
  // Neighbours are added three times over, in all vectors at once: one by one, each number would have to be taken out.
  typedef float Eight __attribute__((vector_size(32)));
  typedef int32_t Places __attribute__((vector_size(32)));
  Eight each[8] = {};
#pragma GCC unroll 8
  for (int i = 0; i < N; ++i) {
    Eight parts[LANES / 8];
    std::memcpy(parts, &of[i], sizeof parts);
    each[i] = parts[0];
    if (LANES == 16) each[i] += parts[LANES / 8 - 1];
  }
  const auto pairs = [](Eight a, Eight b) {
    return SW_SHUFFLED(a, b, 0, 2, 8, 10, 4, 6, 12, 14) + SW_SHUFFLED(a, b, 1, 3, 9, 11, 5, 7, 13, 15);
  };
  const Eight first = pairs(pairs(each[0], each[1]), pairs(each[2], each[3]));
  const Eight last = pairs(pairs(each[4], each[5]), pairs(each[6], each[7]));
  const Eight sums = SW_SHUFFLED(first, last, 0, 1, 2, 3, 8, 9, 10, 11) +
                     SW_SHUFFLED(first, last, 4, 5, 6, 7, 12, 13, 14, 15);
#pragma GCC unroll 8
  for (int i = 0; i < N; ++i) to[i] = sums[i];
#else
  for (int i = 0; i < N; ++i) {
    to[i] = 0.f;
    for (int lane = 0; lane < LANES; ++lane) to[i] += of[i][lane];
  }
#endif
}

// c [rows, columns] = (or += with kAdd) a [rows, inner] b [inner, columns]. Numbers of a stand a_row and a_inner apart;
// rows is a multiple of ROWS, columns of TILE.
template <bool kAdd>
inline void product(const float* a, int64_t a_row, int64_t a_inner, const float* b, int64_t b_row, int64_t inner,
                    float* c, int64_t c_row, int64_t rows, int64_t columns) {
  for (int64_t column = 0; column < columns; column += TILE)
    for (int64_t row = 0; row < rows; row += ROWS) {
      Vec sum[ROWS][WIDE];
#pragma GCC unroll 12
      for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 2
        for (int v = 0; v < WIDE; ++v)
          sum[r][v] = kAdd ? load(c + (row + r) * c_row + column + v * LANES) : Vec{};
      const float* from = a + row * a_row;
      const float* with = b + column;
      for (int64_t i = 0; i < inner; ++i, from += a_inner, with += b_row) {
        const Vec first = load(with), second = load(with + LANES);
#pragma GCC unroll 12
        for (int r = 0; r < ROWS; ++r) {
          const Vec factor = all(from[r * a_row]);
          sum[r][0] += factor * first, sum[r][1] += factor * second;
        }
      }
#pragma GCC unroll 12
      for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 2
        for (int v = 0; v < WIDE; ++v) store(c + (row + r) * c_row + column + v * LANES, sum[r][v]);
    }
}

// e^x within 2 units in the last place, x moved into -87 .. 88. Source: Cephes mathematical library, expf.
inline Vec exponential(Vec x) {
  x = x < all(-87.f) ? all(-87.f) : x;
  x = x > all(88.f) ? all(88.f) : x;
  const Vec magic = all(12582912.f);  // 1.5 * 2^23: a sum with it has no fraction
  const Vec n = (x * all(1.44269504f) + magic) - magic;
  const Vec r = (x - n * all(0.693359375f)) - n * all(-2.12194440e-4f);
  Vec p = all(1.9875691500e-4f);
  for (const float c : {1.3981999507e-3f, 8.3334519073e-3f, 4.1665795894e-2f, 1.6666665459e-1f, 5.0000001201e-1f})
    p = p * r + all(c);
  const IntVec power = (__builtin_convertvector(n, IntVec) + 127) << 23;
  return (p * r * r + r + all(1.f)) * reinterpret_cast<Vec>(power);
}

}  // namespace SW_ARCH
