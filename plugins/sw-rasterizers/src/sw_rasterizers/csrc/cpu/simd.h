// Packs of floats that the shared mathematics runs on, one lane a Gaussian or a pixel.
//
// They are the compiler's own vector types, not intrinsics: the same text becomes AVX-512, AVX2, SSE or NEON code, and
// stays vectorised whatever the optimiser thinks of a loop. SW_LANES=1 turns packs into plain floats: the same source
// without vectorisation (the benchmark's baseline).
#pragma once

#include <utility>

#include "../common.h"

#if !defined(SW_LANES)
#if defined(__AVX512F__) && defined(__AVX512DQ__)
#define SW_LANES 16
#elif defined(__AVX2__)
#define SW_LANES 8
#elif defined(__SSE2__) || defined(__ARM_NEON)
#define SW_LANES 4
#else
#define SW_LANES 1
#endif
#endif

namespace sw {

template <class V>
struct PackTraits {
  static constexpr int lanes = 1;
  using Int = int32_t;
};

#if SW_LANES > 1
typedef float PackF __attribute__((vector_size(4 * SW_LANES)));
typedef int32_t PackI __attribute__((vector_size(4 * SW_LANES)));
typedef uint32_t PackU __attribute__((vector_size(4 * SW_LANES)));

template <>
struct ScalarOf<PackF> {
  using type = float;
};
template <>
struct PackTraits<PackF> {
  static constexpr int lanes = SW_LANES;
  using Int = PackI;
};

SW_HD PackF select(PackI condition, PackF yes, PackF no) { return condition ? yes : no; }
SW_HD PackI select(PackI condition, PackI yes, PackI no) { return condition ? yes : no; }

SW_HD PackF square_root(PackF x) {
  for (int i = 0; i < SW_LANES; ++i) x[i] = __builtin_sqrtf(x[i]);
  return x;
}
SW_HD PackF round_up(PackF x) {
  for (int i = 0; i < SW_LANES; ++i) x[i] = __builtin_ceilf(x[i]);
  return x;
}
SW_HD PackF round_down(PackF x) {
  for (int i = 0; i < SW_LANES; ++i) x[i] = __builtin_floorf(x[i]);
  return x;
}
SW_HD PackF absolute(PackF x) { return (PackF)((PackI)x & 0x7fffffff); }

SW_HD bool any(PackI mask) {
#if defined(__x86_64__) && SW_LANES == 8
  return __builtin_ia32_movmskps256((PackF)mask) != 0;  // one instruction
#elif defined(__x86_64__) && SW_LANES == 4
  return __builtin_ia32_movmskps((PackF)mask) != 0;
#elif defined(__AVX512F__) && SW_LANES == 16 && !defined(__clang__)
  return __builtin_ia32_ptestmd512(mask, mask, -1) != 0;  // two; clang finds them in what follows
#else
  typedef int64_t Wide __attribute__((vector_size(4 * SW_LANES)));
  const Wide pairs = (Wide)mask;
  int64_t found = 0;
  for (int i = 0; i < SW_LANES / 2; ++i) found |= pairs[i];
  return found != 0;
#endif
}
SW_HD bool lane(PackI mask, int i) { return mask[i] != 0; }
SW_HD float lane(PackF x, int i) { return x[i]; }

// Lane i of the result is lane Pick::at(i) of a (if below SW_LANES) or of b.
template <class Pick, int... I>
SW_HD PackF shuffle_lanes(PackF a, PackF b, std::integer_sequence<int, I...>) {
#if defined(__clang__)
  return __builtin_shufflevector(a, b, Pick::at(I)...);
#else
  return __builtin_shuffle(a, b, PackI{Pick::at(I)...});
#endif
}
template <class Pick>
SW_HD PackF shuffle(PackF a, PackF b) {
  return shuffle_lanes<Pick>(a, b, std::make_integer_sequence<int, SW_LANES>{});
}

// Groups of 2 width lanes: the lower halves of a's and b's groups side by side, or the upper ones.
template <int width, bool upper>
struct HalfGroups {
  static constexpr int at(int i) {
    const int group = i / (2 * width) * (2 * width), k = i % (2 * width), half = upper ? width : 0;
    return k < width ? group + half + k : SW_LANES + group + half + k - width;
  }
};
struct BitReversed {
  static constexpr int at(int i) {
    int reversed = 0;
    for (int bit = 1; bit < SW_LANES; bit *= 2) reversed = 2 * reversed + (i & bit ? 1 : 0);
    return reversed;
  }
};

// Sums over lanes of `count` <= SW_LANES packs, sum i in lane i; `packs` is overwritten. A tree of folds that halves
// the number of packs and of lanes per sum at once: three operations a fold instead of log2(lanes) steps a pack.
template <int width, int count>
SW_HD PackF fold_lanes(PackF* packs) {
#pragma GCC unroll 8
  for (int i = 0; i < count; i += 2) {
    const PackF a = packs[i], b = i + 1 < count ? packs[i + 1] : a;
    packs[i / 2] = shuffle<HalfGroups<width, false>>(a, b) + shuffle<HalfGroups<width, true>>(a, b);
  }
  if constexpr (width > 1)
    return fold_lanes<width / 2, (count + 1) / 2>(packs);
  else
    return shuffle<BitReversed>(packs[0], packs[0]);
}

// rows[i] lane k <-> rows[k] lane i.
template <int width>
SW_HD void transpose_step(PackF* rows) {
  for (int i = 0; i < SW_LANES; ++i) {
    if (i & width) continue;
    const PackF a = rows[i], b = rows[i + width];
    rows[i] = shuffle<HalfGroups<width, false>>(a, b);
    rows[i + width] = shuffle<HalfGroups<width, true>>(a, b);
  }
  if constexpr (width > 1) transpose_step<width / 2>(rows);
}
SW_HD void transpose(PackF* rows) { transpose_step<SW_LANES / 2>(rows); }

SW_HD float horizontal_sum(PackF x) {
  float part[SW_LANES];
  __builtin_memcpy(part, &x, sizeof part);
  for (int width = SW_LANES / 2; width > 0; width /= 2)
    for (int i = 0; i < width; ++i) part[i] += part[i + width];
  return part[0];
}
using Lanes = PackF;
#else
using Lanes = float;
#endif

SW_HD bool lane(bool mask, int) { return mask; }
SW_HD bool lane(int mask, int) { return mask != 0; }
SW_HD float lane(float x, int) { return x; }
SW_HD double lane(double x, int) { return x; }
SW_HD float horizontal_sum(float x) { return x; }
SW_HD double horizontal_sum(double x) { return x; }

template <class V>
constexpr int lanes_of = PackTraits<V>::lanes;
template <class V>
using IntOf = typename PackTraits<V>::Int;

template <class V>
SW_HD void transpose(V*) {}  // one lane

SW_HD float to_real(int32_t x) { return float(x); }
SW_HD int32_t to_integer(float x) { return int32_t(x); }
SW_HD int32_t to_integer(double x) { return int32_t(x); }
#if SW_LANES > 1
SW_HD PackF to_real(PackI x) { return __builtin_convertvector(x, PackF); }
SW_HD PackI to_integer(PackF x) { return __builtin_convertvector(x, PackI); }
#endif

template <class V>
SW_HD V load(const void* from) {
  V value;
  __builtin_memcpy(&value, from, sizeof value);
  return value;
}
template <class V>
SW_HD void store(void* to, V value) {
  __builtin_memcpy(to, &value, sizeof value);
}

// out[i] = sum over lanes of packs[i]; `packs` is overwritten.
template <class V, int kCount>
SW_HD void lane_sums(V* packs, Scalar<V>* out) {
  constexpr int L = lanes_of<V>;
  if constexpr (L == 1) {
    for (int i = 0; i < kCount; ++i) out[i] = packs[i];
  } else {
    constexpr int kWhole = kCount / L * L, kRest = kCount - kWhole;  // constant counts: folds stay in registers
    for (int first = 0; first < kWhole; first += L) store(out + first, fold_lanes<L / 2, L>(packs + first));
    if constexpr (kRest > 0) {
      const V sums = fold_lanes<L / 2, kRest>(packs + kWhole);
      __builtin_memcpy(out + kWhole, &sums, sizeof(Scalar<V>) * kRest);
    }
  }
}

// 2^x for finite x > -126; relative error below 1e-7. Below that, and for x without meaning, the result is arbitrary
// (the caller has a mask for those lanes) but no trap. Nearest-integer split by the magic number 1.5 * 2^23, minimax
// polynomial on [-1/2, 1/2], exponent added as an integer; U is unsigned, since it may wrap around.
template <class V, class U>
SW_HD V exp2_pack(V x) {
  const V shifted = x + 12582912.0f;
  const V r = x - (shifted - 12582912.0f);
  V p = constant<V>(1.3276460597748346e-3);
  p = p * r + constant<V>(9.675541243482902e-3);
  p = p * r + constant<V>(5.550713308745793e-2);
  p = p * r + constant<V>(2.402211972610481e-1);
  p = p * r + constant<V>(6.93146967043179e-1);
  p = p * r + constant<V>(1.0000000716539854);
  U bits, n;
  __builtin_memcpy(&bits, &p, sizeof bits);
  __builtin_memcpy(&n, &shifted, sizeof n);
  bits += n << 23;
  V result;
  __builtin_memcpy(&result, &bits, sizeof result);
  return result;
}

// log2 of a positive normal x, absolute error below 2e-7: x = m 2^n with m in [sqrt(1/2), sqrt 2), atanh series in
// (m - 1)/(m + 1).
template <class V, class I>
SW_HD V log2_pack(V x) {
  I bits;
  __builtin_memcpy(&bits, &x, sizeof bits);
  const I n = (bits - 0x3f3504f3) >> 23;
  bits -= n << 23;
  V m;
  __builtin_memcpy(&m, &bits, sizeof m);
  const V s = (m - constant<V>(1)) / (m + constant<V>(1)), s2 = s * s;
  V p = constant<V>(2.0 / 9.0 * kLog2e);
  p = p * s2 + constant<V>(2.0 / 7.0 * kLog2e);
  p = p * s2 + constant<V>(2.0 / 5.0 * kLog2e);
  p = p * s2 + constant<V>(2.0 / 3.0 * kLog2e);
  p = p * s2 + constant<V>(2.0 * kLog2e);
  return p * s + to_real(n);
}

#if SW_LANES > 1
SW_HD PackF log_2(PackF x) { return log2_pack<PackF, PackI>(x); }
SW_HD PackF exp_2(PackF x) { return exp2_pack<PackF, PackU>(x); }
#endif
SW_HD float exp_2(float x) { return exp2_pack<float, uint32_t>(x); }
SW_HD double exp_2(double x) { return exp2(x); }

}  // namespace sw
