// Prices of merging neighbours along a curve, and the cheapest neighbour of each Gaussian: merge_costs.py and _wave of
// simplifying.py have the formulas, this file has them pair by pair.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>

#include "kernels.h"

namespace SW_ARCH {
namespace {

constexpr float kSmallest = 1e-36f, kPi = 3.14159265358979f;
constexpr float kColorPrice = 4e-6f * kPi;

struct Six {
  float xx, xy, xz, yy, yz, zz;
};
struct Vec {
  float x, y, z;
};

inline float at_least(float a, float low) { return a < low ? low : a; }  // of NaN it is NaN, as torch has it

inline Six sum(const Six& a, const Six& b) {
  return {a.xx + b.xx, a.xy + b.xy, a.xz + b.xz, a.yy + b.yy, a.yz + b.yz, a.zz + b.zz};
}
inline Six outer(const Vec& d) { return {d.x * d.x, d.x * d.y, d.x * d.z, d.y * d.y, d.y * d.z, d.z * d.z}; }
inline Six adjugate(const Six& s) {
  return {s.yy * s.zz - s.yz * s.yz, s.xz * s.yz - s.xy * s.zz, s.xy * s.yz - s.xz * s.yy,
          s.xx * s.zz - s.xz * s.xz, s.xy * s.xz - s.xx * s.yz, s.xx * s.yy - s.xy * s.xy};
}
inline float determinant(const Six& s) {
  return s.xx * (s.yy * s.zz - s.yz * s.yz) - s.xy * (s.xy * s.zz - s.yz * s.xz) +
         s.xz * (s.xy * s.yz - s.yy * s.xz);
}
inline float along(const Six& s, const Vec& v) {
  return v.x * (s.xx * v.x + 2 * (s.xy * v.y + s.xz * v.z)) + v.y * (s.yy * v.y + 2 * s.yz * v.z) + s.zz * v.z * v.z;
}
inline float mahalanobis(const Six& s, const Vec& d, float det) {
  return at_least(along(adjugate(s), d), 0) / at_least(det, kSmallest);
}
inline float dot(const float* a, const float* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Integral of the product of two Gaussians, over (2 pi)^(3/2).
inline float product(float volume_a, float volume_b, const Six& both, const Vec& d) {
  const float det = determinant(both);
  return volume_a * (volume_b / std::sqrt(at_least(det, kSmallest))) * std::exp(-mahalanobis(both, d, det) / 2);
}

inline float least_eigenvalue(const Six& s) {
  const float middle = (s.xx + s.yy + s.zz) / 3;
  const float x = s.xx - middle, y = s.yy - middle, z = s.zz - middle;
  const float off = s.xy * s.xy + s.xz * s.xz + s.yz * s.yz;
  const float p = std::sqrt((x * x + y * y + z * z + 2 * off) / 6);
  const float det =
      x * (y * z - s.yz * s.yz) - s.xy * (s.xy * z - s.yz * s.xz) + s.xz * (s.xy * s.yz - y * s.xz);
  const float r = std::min(std::max(det / at_least(2 * p * p * p, kSmallest), -1.f), 1.f);
  return at_least(middle + 2 * p * std::cos(std::acos(r) / 3 + 2 * kPi / 3), 0);
}

// Unit eigenvector of an eigenvalue: the longest product of two rows of S - value I; any of a sphere.
inline Vec null_vector(const Six& s, float value) {
  const Six q = adjugate({s.xx - value, s.xy, s.xz, s.yy - value, s.yz, s.zz - value});
  const float a = std::abs(q.xx), d = std::abs(q.yy), f = std::abs(q.zz);
  const Vec v = a >= d && a >= f ? Vec{q.xx, q.xy, q.xz} : d >= f ? Vec{q.xy, q.yy, q.yz} : Vec{q.xz, q.yz, q.zz};
  const float length = std::sqrt(v.x * v.x + v.y * v.y + v.z * v.z);
  return length > kSmallest ? Vec{v.x / length, v.y / length, v.z / length} : Vec{1, 0, 0};
}

// A row of the table: place 3, covariance 6, volume, mass, opacity, colour 3.
struct Row {
  Vec place;
  Six six;
  float volume, mass, opacity;
  float color[3];
};
static_assert(sizeof(Row) == 15 * sizeof(float), "rows lie without gaps");

float ink_opacity(const Row& a, const Row& b, const Six& both, const Vec& d, const Six& six) {
  const Vec normal = null_vector(six, least_eigenvalue(six));
  const float pa = at_least(along(adjugate(a.six), normal), 0), pb = at_least(along(adjugate(b.six), normal), 0);
  const float pm = at_least(along(adjugate(six), normal), 0);
  const float pab = at_least(along(adjugate(both), normal), kSmallest);
  const float inner = at_least(along(adjugate(sum(both, outer(d))), normal) / pab - 1, 0);
  const float ink_a = a.opacity * std::sqrt(pa), ink_b = b.opacity * std::sqrt(pb);
  const float shared = a.opacity * b.opacity * std::sqrt(pa * (pb / pab)) * std::exp(-inner / 2);
  const float wanted = std::max(ink_a + ink_b - shared, std::max(ink_a, ink_b));
  const float found = pm > 0 ? wanted / std::sqrt(at_least(pm, kSmallest)) : std::max(a.opacity, b.opacity);
  return std::min(at_least(found, 0), 1.f);
}

float price(const Row& a, const Row& b, const Six& both, const Vec& d, float rest) {
  const float total = a.mass + b.mass;
  const float share = total > 0 ? a.mass / at_least(total, kSmallest) : .5f, other = 1 - share;
  const Six far = outer(d);
  const float mixed = share * other;
  const Six six{share * a.six.xx + other * b.six.xx + mixed * far.xx, share * a.six.xy + other * b.six.xy + mixed * far.xy,
                share * a.six.xz + other * b.six.xz + mixed * far.xz, share * a.six.yy + other * b.six.yy + mixed * far.yy,
                share * a.six.yz + other * b.six.yz + mixed * far.yz, share * a.six.zz + other * b.six.zz + mixed * far.zz};
  const float at = a.opacity, bt = b.opacity, mt = ink_opacity(a, b, both, d, six);
  float color[3], apart = 0;
  for (int c = 0; c < 3; ++c) {
    color[c] = share * a.color[c] + other * b.color[c];
    apart += (a.color[c] - b.color[c]) * (a.color[c] - b.color[c]);
  }
  const float volume = std::sqrt(at_least(determinant(six), 0));
  float field = (at * at * dot(a.color, a.color) * a.volume + bt * bt * dot(b.color, b.color) * b.volume +
                 mt * mt * dot(color, color) * volume) / 2.82842712474619f;
  field += 2 * at * bt * dot(a.color, b.color) * product(a.volume, b.volume, both, d);
  field -= 2 * at * mt * dot(a.color, color) *
           product(a.volume, volume, sum(a.six, six), {other * d.x, other * d.y, other * d.z});
  field -= 2 * bt * mt * dot(b.color, color) *
           product(b.volume, volume, sum(b.six, six), {share * d.x, share * d.y, share * d.z});
  apart += rest / (4 * kPi);
  return 15.7496099457224f * at_least(field, 0) + kColorPrice * apart;
}

// A number in 0..1 for each pair, as good as drawn.
inline float lot(uint32_t row, uint32_t offset, uint32_t wave) {
  uint32_t mixed = row * 2654435761u + offset * 40503u + wave * 97u;
  mixed = (mixed ^ (mixed >> 15)) * 2246822519u;
  return float((mixed ^ (mixed >> 13)) & 0xFFFF) / 65535;
}

float squared_distance(const float* a, const float* b, int64_t n) {
  float sum = 0;
#pragma omp simd reduction(+ : sum)
  for (int64_t i = 0; i < n; ++i) sum += (a[i] - b[i]) * (a[i] - b[i]);
  return sum;
}

}  // namespace

void merge_partners(const splatwizard::MergePartnersArgs& args, const splatwizard::Parallel& parallel) {
  const int64_t n = args.n, window = args.window, width = args.width;
  const Row* rows = reinterpret_cast<const Row*>(args.table);
  constexpr float none = std::numeric_limits<float>::infinity();
  parallel(n, 1024, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; ++i)
      for (int64_t k = 1; k <= window; ++k) {
        float& found = args.prices[i * window + k - 1];
        found = none;
        if (i + k >= n) continue;
        const int64_t at = args.order[i], other = args.order[i + k];
        const Row &a = rows[at], &b = rows[other];
        const Six both = sum(a.six, b.six);
        const Vec d{b.place.x - a.place.x, b.place.y - a.place.y, b.place.z - a.place.z};
        if (!(mahalanobis(both, d, determinant(both)) < args.near)) continue;
        const float rest = squared_distance(args.sh + at * width + 3, args.sh + other * width + 3, width - 3);
        float p = price(a, b, both, d, rest);
        if (!(p < 3e38f)) p = 3e38f;
        if (args.weights != nullptr) p = p * (args.weights[at] + args.weights[other]) / 2;
        // Equal prices, as of copies, would have all point the same way.
        found = p * (1 + 1e-5f * lot(uint32_t(i), uint32_t(k), args.wave)) +
                1e-30f * lot(uint32_t(i), uint32_t(k), args.wave + 1);
      }
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
