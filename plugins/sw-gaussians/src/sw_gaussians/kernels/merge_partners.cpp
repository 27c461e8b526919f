// Prices of merging neighbours along a curve, and the cheapest neighbour of each Gaussian: merge_costs.py and _wave of
// simplifying.py have the formulas, here they are on packs of pairs.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>

#include "kernels.h"

namespace SW_ARCH {
namespace {

#if defined(__AVX512F__)
constexpr int kLanes = 16;
#elif defined(__AVX2__)
constexpr int kLanes = 8;
#else
constexpr int kLanes = 4;
#endif
// The compiler's own vectors: they stay vectors whatever the optimiser thinks of a loop.
typedef float Real __attribute__((vector_size(4 * kLanes)));
typedef int32_t Mask __attribute__((vector_size(4 * kLanes)));
typedef uint32_t Bits __attribute__((vector_size(4 * kLanes)));

constexpr float kSmallest = 1e-36f, kPi = 3.14159265358979f;
constexpr float kColorPrice = 4e-6f * kPi;
// Columns of the table: place 3, covariance 6, volume, mass, opacity, colour 3.
constexpr int kColumns = 15, kRows = 256, kMostWindow = 64, kNeeded = kRows + kMostWindow + kLanes;

struct Six {
  Real xx, xy, xz, yy, yz, zz;
};
struct Vec {
  Real x, y, z;
};
struct Row {
  Vec place;
  Six six;
  Real volume, mass, opacity;
  Vec color;
};
static_assert(sizeof(Row) == kColumns * sizeof(Real), "packs lie without gaps");

inline Real at_least(Real a, float low) { return a < low ? Real{} + low : a; }  // of NaN it is NaN, as torch has it
inline Real larger(Real a, Real b) { return a > b ? a : b; }
inline Real smaller(Real a, Real b) { return a < b ? a : b; }
inline Real absolute(Real a) { return Real(Mask(a) & 0x7fffffff); }
inline Real root(Real a) {
  for (int i = 0; i < kLanes; ++i) a[i] = __builtin_sqrtf(a[i]);
  return a;
}
// e to the power of -x, x >= 0, within 2e-7 of it; 1.6e-38 beyond 87. Of NaN it is NaN.
inline Real exp_of_minus(Real x) {
  x = -smaller(x, Real{} + 87);
  const Real shifted = x * 1.44269504f + 12582912.f;  // 1.5 * 2^23: its low bits are the nearest integer
  const Real n = shifted - 12582912.f;
  const Real r = x - n * .693359375f + n * 2.12194440e-4f;
  Real p = 1.9875691500e-4f * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  return (p * r * r + r + 1) * Real((Bits(shifted) + 127) << 23);
}

inline Six sum(const Six& a, const Six& b) {
  return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz};
}
inline Six outer(const Vec& d) { return {d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z}; }
inline Six adjugate(const Six& s) {
  return {s.yy * s.zz - s.yz * s.yz, s.xz * s.yz - s.xy * s.zz, s.xy * s.yz - s.xz * s.yy,
          s.xx * s.zz - s.xz * s.xz, s.xy * s.xz - s.xx * s.yz, s.xx * s.yy - s.xy * s.xy};
}
inline Real determinant(const Six& s) {
  return s.xx * (s.yy * s.zz - s.yz * s.yz) - s.xy * (s.xy * s.zz - s.yz * s.xz) +
         s.xz * (s.xy * s.yz - s.yy * s.xz);
}
inline Real along(const Six& s, const Vec& v) {
  return v.x * (s.xx * v.x + 2 * (s.xy * v.y + s.xz * v.z)) + v.y * (s.yy * v.y + 2 * s.yz * v.z) + s.zz * v.z * v.z;
}
inline Real mahalanobis(const Six& s, const Vec& d, Real det) {
  return at_least(along(adjugate(s), d), 0) / at_least(det, kSmallest);
}
inline Real dot(const Vec& a, const Vec& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// Integral of the product of two Gaussians, over (2 pi)^(3/2).
inline Real product(Real volume_a, Real volume_b, const Six& both, const Vec& d) {
  const Real det = determinant(both);
  return volume_a * (volume_b / root(at_least(det, kSmallest))) * exp_of_minus(mahalanobis(both, d, det) / 2);
}

inline Real least_eigenvalue(const Six& s) {
  const Real middle = (s.xx + s.yy + s.zz) / 3;
  const Real x = s.xx - middle, y = s.yy - middle, z = s.zz - middle;
  const Real off = s.xy * s.xy + s.xz * s.xz + s.yz * s.yz;
  const Real p = root((x * x + y * y + z * z + 2 * off) / 6);
  const Real det = x * (y * z - s.yz * s.yz) - s.xy * (s.xy * z - s.yz * s.xz) + s.xz * (s.xy * s.yz - y * s.xz);
  const Real r = smaller(larger(det / at_least(2 * p * p * p, kSmallest), Real{} - 1), Real{} + 1);
  // cos(acos(r) / 3 + 2 pi / 3), a polynomial of the sine of half the angle: within 1e-7 of it.
  const Real h = root((1 - r) / 2);
  Real c = 6.39314366e-4f * h - 3.70768647e-3f;
  c = c * h + 1.03254931e-2f;
  c = c * h - 1.96757182e-2f;
  c = c * h + 3.19612955e-2f;
  c = c * h - 5.3288656e-2f;
  c = c * h + 1.11095683e-1f;
  c = c * h - 5.7734972e-1f;
  c = c * h - .5f;
  return at_least(middle + 2 * p * c, 0);
}

// Unit eigenvector of an eigenvalue: the longest product of two rows of S - value I; any of a sphere.
inline Vec null_vector(const Six& s, Real value) {
  const Six q = adjugate({s.xx - value, s.xy, s.xz, s.yy - value, s.yz, s.zz - value});
  const Real a = absolute(q.xx), d = absolute(q.yy), f = absolute(q.zz);
  const Mask first = (a >= d) & (a >= f), second = d >= f;
  const Vec v{first ? q.xx : second ? q.xy : q.xz, first ? q.xy : second ? q.yy : q.yz,
              first ? q.xz : second ? q.yz : q.zz};
  const Real length = root(dot(v, v)), divisor = at_least(length, kSmallest), none{};
  const Mask sound = length > kSmallest;
  return {sound ? v.x / divisor : none + 1, sound ? v.y / divisor : none, sound ? v.z / divisor : none};
}

Real ink_opacity(const Row& a, const Row& b, const Six& both, const Vec& d, const Six& six) {
  const Vec normal = null_vector(six, least_eigenvalue(six));
  const Real pa = at_least(along(adjugate(a.six), normal), 0), pb = at_least(along(adjugate(b.six), normal), 0);
  const Real pm = at_least(along(adjugate(six), normal), 0);
  const Real pab = at_least(along(adjugate(both), normal), kSmallest);
  const Real inner = at_least(along(adjugate(sum(both, outer(d))), normal) / pab - 1, 0);
  const Real ink_a = a.opacity * root(pa), ink_b = b.opacity * root(pb);
  const Real shared = a.opacity * b.opacity * root(pa * (pb / pab)) * exp_of_minus(inner / 2);
  const Real wanted = larger(ink_a + ink_b - shared, larger(ink_a, ink_b));
  const Real found = pm > 0 ? wanted / root(at_least(pm, kSmallest)) : larger(a.opacity, b.opacity);
  return smaller(at_least(found, 0), Real{} + 1);
}

// Of pairs, without what their higher bands differ by.
Real price(const Row& a, const Row& b) {
  const Six both = sum(a.six, b.six);
  const Vec d{b.place.x - a.place.x, b.place.y - a.place.y, b.place.z - a.place.z};
  const Real total = a.mass + b.mass;
  const Real share = total > 0 ? a.mass / at_least(total, kSmallest) : Real{} + .5f, other = 1 - share;
  const Six far = outer(d);
  const Real mixed = share * other;
  const Six six{share * a.six.xx + other * b.six.xx + mixed * far.xx, share * a.six.xy + other * b.six.xy + mixed * far.xy,
                share * a.six.xz + other * b.six.xz + mixed * far.xz, share * a.six.yy + other * b.six.yy + mixed * far.yy,
                share * a.six.yz + other * b.six.yz + mixed * far.yz, share * a.six.zz + other * b.six.zz + mixed * far.zz};
  const Real at = a.opacity, bt = b.opacity, mt = ink_opacity(a, b, both, d, six);
  const Vec color{share * a.color.x + other * b.color.x, share * a.color.y + other * b.color.y,
                  share * a.color.z + other * b.color.z};
  const Vec change{a.color.x - b.color.x, a.color.y - b.color.y, a.color.z - b.color.z};
  const Real volume = root(at_least(determinant(six), 0));
  Real field = (at * at * dot(a.color, a.color) * a.volume + bt * bt * dot(b.color, b.color) * b.volume +
                mt * mt * dot(color, color) * volume) / 2.82842712474619f;
  field += 2 * at * bt * dot(a.color, b.color) * product(a.volume, b.volume, both, d);
  field -= 2 * at * mt * dot(a.color, color) *
           product(a.volume, volume, sum(a.six, six), {other * d.x, other * d.y, other * d.z});
  field -= 2 * bt * mt * dot(b.color, color) *
           product(b.volume, volume, sum(b.six, six), {share * d.x, share * d.y, share * d.z});
  return 15.7496099457224f * at_least(field, 0) + kColorPrice * dot(change, change);
}

// A number in 0..1 for each pair, as good as drawn.
inline Real lot(Bits row, uint32_t offset, uint32_t wave) {
  Bits mixed = row * 2654435761u + (offset * 40503u + wave * 97u);
  mixed = (mixed ^ (mixed >> 15)) * 2246822519u;
  return __builtin_convertvector(Mask((mixed ^ (mixed >> 13)) & 0xFFFF), Real) / 65535;
}

float squared_distance(const float* a, const float* b, int64_t n) {
  float sum = 0;
#pragma omp simd reduction(+ : sum)
  for (int64_t i = 0; i < n; ++i) sum += (a[i] - b[i]) * (a[i] - b[i]);
  return sum;
}

template <class V>
inline V load(const void* from) {
  V value;
  std::memcpy(&value, from, sizeof value);
  return value;
}

// A run of the curve with the window behind it, column by column, and pairs of it.
class Run {
 public:
  void price_pairs(const splatwizard::MergePartnersArgs& args, int64_t start) {
    const int64_t n = args.n, *order = args.order + start;
    const int count = int(std::min<int64_t>(kRows, n - start)), window = int(args.window);
    const int there = int(std::min<int64_t>(n - start, count + window));
    for (int i = 0; i < there; ++i)
      for (int c = 0; c < kColumns; ++c) rows_[c][i] = args.table[order[i] * kColumns + c];
    float* prices = args.prices + start * window;
    std::fill(prices, prices + count * window, std::numeric_limits<float>::infinity());
    for (int k = 1; k <= window; ++k) {
      const int near = find_near(std::min(count, there - k), k, args.near);
      for (int j = 0; j < near; j += kLanes) price_pack(args, start, k, j, std::min(kLanes, near - j));
    }
  }

 private:
  // Writes the first rows of the pairs that are near, of so many that are k apart.
  int find_near(int pairs, int k, float limit) {
    int found = 0;
    for (int i = 0; i < pairs; i += kLanes) {
      Real a[9], b[9];
      for (int c = 0; c < 9; ++c) a[c] = load<Real>(rows_[c] + i), b[c] = load<Real>(rows_[c] + i + k);
      const Six both{a[3] + b[3], a[4] + b[4], a[5] + b[5], a[6] + b[6], a[7] + b[7], a[8] + b[8]};
      const Vec d{b[0] - a[0], b[1] - a[1], b[2] - a[2]};
      const Mask near = mahalanobis(both, d, determinant(both)) < limit;
      for (int l = 0; l < kLanes; ++l) {
        first_[found] = i + l;
        found += near[l] != 0 && i + l < pairs;
      }
    }
    return found;
  }

  void price_pack(const splatwizard::MergePartnersArgs& args, int64_t start, int k, int begin, int some) {
    const int64_t *order = args.order + start, width = args.width;
    const int32_t* first = first_ + begin;
    float a[kColumns][kLanes] = {}, b[kColumns][kLanes] = {}, rest[kLanes] = {}, weight[kLanes] = {};
    for (int l = 0; l < some; ++l) {
      const int i = first[l];
      for (int c = 0; c < kColumns; ++c) a[c][l] = rows_[c][i], b[c][l] = rows_[c][i + k];
      const int64_t one = order[i], other = order[i + k];
      rest[l] = squared_distance(args.sh + one * width + 3, args.sh + other * width + 3, width - 3);
      weight[l] = args.weights == nullptr ? 1 : (args.weights[one] + args.weights[other]) / 2;
    }
    Real found = price(load<Row>(a), load<Row>(b)) + kColorPrice * (load<Real>(rest) / (4 * kPi));
    found = (found < 3e38f ? found : Real{} + 3e38f) * load<Real>(weight);
    // Equal prices, as of copies, would have all point the same way.
    const Bits row = load<Bits>(first) + uint32_t(start);
    found = found * (1 + 1e-5f * lot(row, k, args.wave)) + 1e-30f * lot(row, k, args.wave + 1);
    for (int l = 0; l < some; ++l) args.prices[(start + first[l]) * args.window + k - 1] = found[l];
  }

  float rows_[kColumns][kNeeded] = {};
  int32_t first_[kRows + kLanes] = {};
};

}  // namespace

void merge_partners(const splatwizard::MergePartnersArgs& args, const splatwizard::Parallel& parallel) {
  const int64_t n = args.n, window = args.window;
  constexpr float none = std::numeric_limits<float>::infinity();
  parallel((n + kRows - 1) / kRows, 4, [&](int64_t first, int64_t last) {
    Run run;
    for (int64_t i = first; i < last; ++i) run.price_pairs(args, i * kRows);
  });
  parallel(n, 4096, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; ++i) {
      float best = none;
      int64_t partner = i;
      for (int64_t k = 1; k <= window; ++k) {
        const float ahead = args.prices[i * window + k - 1];
        if (ahead < best) best = ahead, partner = i + k;
        if (i < k) continue;
        const float behind = args.prices[(i - k) * window + k - 1];
        if (behind < best) best = behind, partner = i - k;
      }
      args.best[i] = best;
      args.partner[i] = partner;
    }
  });
}

}  // namespace SW_ARCH
