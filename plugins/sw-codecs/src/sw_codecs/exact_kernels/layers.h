// Layers of a network on integers, for a few rows at once: by 16-bit products where all sums stay below 2^31, else in
// float64. Both are exact, so that which one is taken changes no result.
#pragma once
#ifdef __SSE2__
#include <immintrin.h>
#elif defined(__wasm_simd128__)
#include <wasm_simd128.h>
#endif

#include "kernels.h"
#include "rans.h"
#include "vectors.h"

namespace SW_ARCH {

// Sums of ROWS rows and WIDE vectors of outputs are kept in registers.
#ifdef __AVX512F__
constexpr int ROWS = 8;
#else
constexpr int ROWS = 4;
#endif
constexpr int WIDE = 3, TILE = 24, BLOCK = 48;
static_assert(TILE % (WIDE * LANES) == 0 && BLOCK % ROWS == 0);

constexpr int64_t DEEP = 128;  // inputs at once: their weights of a tile stay in the first cache

// Adds to sums of ROWS rows, [ROWS, TILE]; `in` has `stride` numbers a row.
inline void add_products(const double* in, int64_t stride, const double* weights, int64_t inputs, double* sums) {
  Vec sum[ROWS][WIDE];
#pragma GCC unroll 8
  for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 8
    for (int v = 0; v < WIDE; ++v) sum[r][v] = load(sums + r * TILE + v * LANES);
  for (int64_t k = 0; k < inputs; ++k) {
    Vec w[WIDE];
#pragma GCC unroll 8
    for (int v = 0; v < WIDE; ++v) w[v] = load(weights + k * TILE + v * LANES);
#pragma GCC unroll 8
    for (int r = 0; r < ROWS; ++r) {
      const Vec a = all(in[r * stride + k]);
#pragma GCC unroll 8
      for (int v = 0; v < WIDE; ++v) sum[r][v] += w[v] * a;
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < ROWS; ++r)
#pragma GCC unroll 8
    for (int v = 0; v < WIDE; ++v) store(sums + r * TILE + v * LANES, sum[r][v]);
}

// Numbers in two parts: x = high << bits | low, with 0 <= low < 2^bits or -2^(bits - 1) <= low < 2^(bits - 1).
constexpr int WEIGHT_BITS = 15, INPUT_BITS = 10;
constexpr double WHOLE = 1LL << 52;
constexpr int32_t SMALL = 32767;  // of 16-bit inputs: two products of -32768 would be 2^31
constexpr int32_t PART = 1 << INPUT_BITS;  // what parts of inputs up to 2^20 do not exceed

#if defined(__SSE2__) || defined(__wasm_simd128__)
constexpr bool HAS_PAIRS = true;
#ifdef __AVX2__
constexpr int SUMS = 8;
#else
constexpr int SUMS = 4;
#endif
typedef int32_t Sum __attribute__((vector_size(4 * SUMS)));
typedef int16_t Pair __attribute__((vector_size(4 * SUMS)));
typedef int16_t PairLoad __attribute__((vector_size(4 * SUMS), aligned(2)));
typedef int32_t SumStore __attribute__((vector_size(4 * SUMS), aligned(4)));
static_assert(TILE % (WIDE * SUMS) == 0 && WIDE * SUMS % LANES == 0);

// a_0 b_0 + a_1 b_1 of each pair.
inline Sum pair_sums(Pair a, Pair b) {
#ifdef __AVX2__
  return reinterpret_cast<Sum>(_mm256_madd_epi16(reinterpret_cast<__m256i>(a), reinterpret_cast<__m256i>(b)));
#elif defined(__wasm_simd128__)
  return reinterpret_cast<Sum>(wasm_i32x4_dot_i16x8(reinterpret_cast<v128_t>(a), reinterpret_cast<v128_t>(b)));
#else
  return reinterpret_cast<Sum>(_mm_madd_epi16(reinterpret_cast<__m128i>(a), reinterpret_cast<__m128i>(b)));
#endif
}

// Adds `factor` times those of the outputs times the products to the first sums of four rows, [4, TILE]; weights
// [pairs, TILE, 2].
inline void add_pairs(const int16_t* in, int64_t stride, const int16_t* weights, int64_t pairs, int64_t outputs,
                      const double* factors, double factor, double* sums) {
  for (int part = 0; part < outputs; part += WIDE * SUMS) {
    Sum sum[4][WIDE] = {};
    for (int64_t k = 0; k < pairs; ++k) {
      Pair w[WIDE];
#pragma GCC unroll 8
      for (int v = 0; v < WIDE; ++v)
        w[v] = *reinterpret_cast<const PairLoad*>(weights + 2 * (k * TILE + part + v * SUMS));
#pragma GCC unroll 8
      for (int r = 0; r < 4; ++r) {
        int32_t pair;
        std::memcpy(&pair, in + r * stride + 2 * k, sizeof(pair));
        const Pair a = reinterpret_cast<Pair>(Sum{} + pair);
#pragma GCC unroll 8
        for (int v = 0; v < WIDE; ++v) sum[r][v] += pair_sums(a, w[v]);
      }
    }
    int32_t found[4][WIDE * SUMS];
    for (int r = 0; r < 4; ++r)
      for (int v = 0; v < WIDE; ++v) *reinterpret_cast<SumStore*>(found[r] + v * SUMS) = sum[r][v];
    for (int r = 0; r < 4; ++r)
      for (int c = 0; c < WIDE * SUMS; c += LANES) {
        double* to = sums + r * TILE + part + c;
        const Narrow x = *reinterpret_cast<const NarrowLoad*>(found[r] + c);
        store(to, load(to) + __builtin_convertvector(x, Vec) * (load(factors + part + c) * all(factor)));
      }
  }
}
#else
constexpr bool HAS_PAIRS = false;
inline void add_pairs(const int16_t*, int64_t, const int16_t*, int64_t, int64_t, const double*, double, double*) {}
#endif

// A layer in tiles of outputs, zeros behind the last one.
struct Tiles {
  int64_t inputs, outputs, pairs, tiles;
  Scratch<double> weights;  // [tiles, inputs, TILE]
  Scratch<double> bias;     // [tiles * TILE]
  Scratch<int16_t> low, high;  // [tiles, pairs, TILE, 2] divided by `factor`
  Scratch<double> factor;      // [tiles * TILE] the power of two that all weights of an output share
  Scratch<int32_t> parts;      // [tiles] of the weights: 1 low, 2 low and high, 0 neither holds them
  Scratch<int64_t> reach;      // [tiles] inputs up to this give sums below 2^31

  explicit Tiles(const splatwizard::Layer& l)
      : inputs(l.inputs), outputs(l.outputs), pairs((l.inputs + 1) / 2), tiles((l.outputs + TILE - 1) / TILE),
        weights(tiles * inputs * TILE), bias(tiles * TILE), low(tiles * pairs * TILE * 2),
        high(tiles * pairs * TILE * 2), factor(tiles * TILE), parts(tiles), reach(tiles) {
    for (int64_t t = 0; t < tiles; ++t) pack(l, t);
  }
  int64_t padded() const { return tiles * TILE; }

 private:
  void pack(const splatwizard::Layer& l, int64_t t) {
    const int64_t first = t * TILE, count = outputs - first < TILE ? outputs - first : TILE;
    double* w = weights.data + first * inputs;
    int64_t largest = 0;
    bool whole = HAS_PAIRS;
    for (int64_t i = 0; i < TILE; ++i) {
      bias[first + i] = i < count ? l.bias[first + i] : 0;
      int64_t bits = 0;
      for (int64_t k = 0; k < inputs; ++k) {
        const double x = w[k * TILE + i] = i < count ? l.weights[(first + i) * inputs + k] : 0;
        whole &= x > -WHOLE && x < WHOLE && x == static_cast<double>(static_cast<int64_t>(x));
        bits |= whole ? static_cast<int64_t>(x < 0 ? -x : x) : 0;
      }
      const int64_t shared = bits & -bits;
      factor[first + i] = shared ? static_cast<double>(shared) : 1;
      for (int64_t k = 0; k < inputs && whole; ++k) {
        const auto x = static_cast<int64_t>(w[k * TILE + i] / factor[first + i]), size = x < 0 ? -x : x;
        largest = size > largest ? size : largest;
      }
    }
    whole &= largest < 1 << 29;
    parts[t] = !whole ? 0 : largest <= SMALL ? 1 : 2;
    reach[t] = 0;
    if (!whole) return;
    int64_t most = 1;  // sum of an output's weights in magnitude
    int16_t *below = low.data + 2 * first * pairs, *above = high.data + 2 * first * pairs;
    for (int64_t i = 0; i < TILE; ++i) {
      int64_t sum = 0, sum_above = 0;
      for (int64_t k = 0; k < 2 * pairs; ++k) {
        const int32_t x = k < inputs ? static_cast<int32_t>(w[k * TILE + i] / factor[first + i]) : 0;
        const int32_t top = parts[t] == 1 ? 0 : (x + (1 << (WEIGHT_BITS - 1))) >> WEIGHT_BITS;
        const int32_t rest = x - top * (1 << WEIGHT_BITS);
        const int64_t at = 2 * (k / 2 * TILE + i) + k % 2;
        below[at] = static_cast<int16_t>(rest);
        above[at] = static_cast<int16_t>(top);
        sum += rest < 0 ? -rest : rest;
        sum_above += top < 0 ? -top : top;
      }
      most = sum > most ? sum : most;
      most = sum_above > most ? sum_above : most;
    }
    reach[t] = ((int64_t{1} << 31) - 1) / most;
  }
};

// Rows on their way through the layers: integers up to 2^20 in magnitude, `stride` a row, zeros behind the last ones.
struct Rows {
  Scratch<int32_t> value;
  Scratch<int16_t> low, high;
  Scratch<double> real;
  int64_t stride = 0, most = 0;  // magnitude
  bool has_small = false, has_parts = false, has_real = false;

  explicit Rows(int64_t widest)
      : value(BLOCK * widest), low(BLOCK * widest), high(BLOCK * widest), real(BLOCK * widest) {}

  void begin(int64_t width) {
    stride = width;
    most = 0;
    has_small = has_parts = has_real = false;
  }
  // The forms in which the layers take them, made when a layer first asks.
  void as_small() {
    if (!has_small)
      for (int64_t i = 0; i < BLOCK * stride; ++i) low[i] = static_cast<int16_t>(value[i]);
    has_small = true;
    has_parts = false;
  }
  void as_parts() {
    if (!has_parts)
      for (int64_t i = 0; i < BLOCK * stride; ++i) {
        low[i] = static_cast<int16_t>(value[i] & (PART - 1));
        high[i] = static_cast<int16_t>(value[i] >> INPUT_BITS);
      }
    has_parts = true;
    has_small = false;
  }
  void as_real() {
    if (!has_real)
      for (int64_t i = 0; i < BLOCK * stride; ++i) real[i] = static_cast<double>(value[i]);
    has_real = true;
  }
};

// Sums of a tile for n rows, [BLOCK, TILE], bias included; what is behind row n is of no use.
inline void tile_sums(const Tiles& l, int64_t t, Rows& rows, int64_t n, double* sums) {
  for (int64_t r = 0; r < BLOCK; ++r) std::memcpy(sums + r * TILE, l.bias.data + t * TILE, sizeof(double) * TILE);
  const int64_t outputs = l.outputs - t * TILE < TILE ? l.outputs - t * TILE : TILE;
  const bool small = rows.most <= SMALL && rows.most <= l.reach[t];
  if (l.parts[t] == 0 || (!small && PART > l.reach[t])) {
    rows.as_real();
    for (int64_t k = 0; k < l.inputs; k += DEEP) {
      const double* weights = l.weights.data + (t * l.inputs + k) * TILE;
      const int64_t deep = l.inputs - k < DEEP ? l.inputs - k : DEEP;
      for (int64_t r = 0; r < n; r += ROWS)
        for (int part = 0; part < outputs; part += WIDE * LANES)
          add_products(rows.real.data + r * rows.stride + k, rows.stride, weights + part, deep,
                       sums + r * TILE + part);
    }
    return;
  }
  small ? rows.as_small() : rows.as_parts();
  for (int top_input = 0; top_input < (small ? 1 : 2); ++top_input)
    for (int top_weight = 0; top_weight < l.parts[t]; ++top_weight) {
      const int16_t* in = top_input ? rows.high.data : rows.low.data;
      const int16_t* weights = (top_weight ? l.high.data : l.low.data) + 2 * t * TILE * l.pairs;
      const auto factor = static_cast<double>(int64_t{1} << (INPUT_BITS * top_input + WEIGHT_BITS * top_weight));
      for (int64_t r = 0; r < n; r += 4)
        add_pairs(in + r * rows.stride, rows.stride, weights, l.pairs, outputs, l.factor.data + t * TILE, factor,
                  sums + r * TILE);
    }
}

}  // namespace SW_ARCH
