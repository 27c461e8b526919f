// One Gaussian in place of each of many pairs: merge_groups of merging.py for two and columns_of of merge_costs.py have
// the formulas. All is in float64 but the spherical harmonics and the table.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>

#include "kernels.h"

namespace SW_ARCH {
namespace {

constexpr double kThomsen = 1.6075, kPi = 3.14159265358979323846, kLeast = 1e-300;
constexpr int kSweeps = 12, kColumns = 15;

using Matrix = double[3][3];

template <class T>
T surface(T a, T b, T c) {
  const T p = T(kThomsen);
  return T(4 * kPi) * std::pow((std::pow(a * b, p) + std::pow(a * c, p) + std::pow(b * c, p)) / 3, 1 / p);
}

// A rotation times its axes' lengths: the matrix whose square is the covariance.
template <class T>
void half_covariance(const T* q, const T* scales, T (&to)[3][3]) {
  const T w = q[0], x = q[1], y = q[2], z = q[3];
  const T rotation[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                            {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                            {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) to[i][j] = rotation[i][j] * scales[j];
}

template <class T>
T row_product(const T (&m)[3][3], int i, int j) {
  return m[i][0] * m[j][0] + m[i][1] * m[j][1] + m[i][2] * m[j][2];
}

// Eigenvalues, ascending, and a rotation whose columns are the axes, by Jacobi's turns; m is overwritten.
void principal_axes(Matrix& m, double* values, Matrix& axes) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) axes[i][j] = i == j;
  for (int sweep = 0; sweep < kSweeps; ++sweep) {
    bool turned = false;
    for (int p = 0; p < 2; ++p)
      for (int q = p + 1; q < 3; ++q) {
        const double off = m[p][q];
        if (!(std::abs(off) > 1e-17 * (std::abs(m[p][p]) + std::abs(m[q][q])))) continue;
        turned = true;
        const double theta = (m[q][q] - m[p][p]) / (2 * off);
        const double t = std::copysign(1 / (std::abs(theta) + std::sqrt(theta * theta + 1)), theta);
        const double c = 1 / std::sqrt(t * t + 1), s = t * c;
        m[p][p] -= t * off;
        m[q][q] += t * off;
        m[p][q] = m[q][p] = 0;
        const int r = 3 - p - q;
        const double rp = m[r][p], rq = m[r][q];
        m[r][p] = m[p][r] = c * rp - s * rq;
        m[r][q] = m[q][r] = s * rp + c * rq;
        for (int i = 0; i < 3; ++i) {
          const double ip = axes[i][p], iq = axes[i][q];
          axes[i][p] = c * ip - s * iq;
          axes[i][q] = s * ip + c * iq;
        }
      }
    if (!turned) break;
  }
  for (int i = 0; i < 3; ++i) values[i] = m[i][i];
  for (const auto& [i, j] : {std::pair{0, 1}, {1, 2}, {0, 1}}) {
    if (values[i] <= values[j]) continue;
    std::swap(values[i], values[j]);
    for (auto& row : axes) {  // a swap would be a reflection: one of them changes its sign
      const double kept = row[i];
      row[i] = row[j];
      row[j] = -kept;
    }
  }
}

// Unit quaternion, w >= 0, of a rotation, by the largest of four candidates.
void quaternion(const Matrix& r, double* q) {
  const double xx = r[0][0], yy = r[1][1], zz = r[2][2];
  const double a = r[2][1] - r[1][2], b = r[0][2] - r[2][0], c = r[1][0] - r[0][1];
  const double d = r[1][0] + r[0][1], e = r[0][2] + r[2][0], f = r[2][1] + r[1][2];
  const double all[4][4] = {{1 + xx + yy + zz, a, b, c},
                            {a, 1 + xx - yy - zz, d, e},
                            {b, d, 1 - xx + yy - zz, f},
                            {c, e, f, 1 - xx - yy + zz}};
  int best = 0;
  for (int i = 1; i < 4; ++i)
    if (all[i][i] > all[best][best]) best = i;
  double norm = 0;
  for (const double each : all[best]) norm += each * each;
  norm = std::copysign(std::max(std::sqrt(norm), 1e-12), all[best][0]);
  for (int i = 0; i < 4; ++i) q[i] = all[best][i] / norm;
}

struct Member {
  double alpha, mass, share, offset[3];
  Matrix half;  // its square is the covariance
};

// Half of the covariance across a normal: what the two other axes see of it. Returns its determinant.
struct Flat {
  double xx, xy, yy, x, y;
  double determinant() const { return std::max(xx * yy - xy * xy, 0.); }
};

Flat across(const Member& member, const Matrix& axes) {
  double seen[2][3];
  for (int axis = 0; axis < 2; ++axis)
    for (int j = 0; j < 3; ++j)
      seen[axis][j] = axes[0][axis + 1] * member.half[0][j] + axes[1][axis + 1] * member.half[1][j] +
                      axes[2][axis + 1] * member.half[2][j];
  const auto dot = [](const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; };
  const auto place = [&](int axis) {
    return member.offset[0] * axes[0][axis] + member.offset[1] * axes[1][axis] + member.offset[2] * axes[2][axis];
  };
  return {dot(seen[0], seen[0]), dot(seen[0], seen[1]), dot(seen[1], seen[1]), place(1), place(2)};
}

// The integral of the joint opacity of two over the plane across the first axis, over 2 pi.
double ink(const Member& a, const Member& b, const Matrix& axes) {
  const Flat one = across(a, axes), other = across(b, axes);
  const double det_a = one.determinant(), det_b = other.determinant();
  const Flat both{one.xx + other.xx, one.xy + other.xy, one.yy + other.yy, one.x - other.x, one.y - other.y};
  const double det = std::max(both.determinant(), kLeast);
  const double apart = both.x * both.x * both.yy - 2 * both.x * both.y * both.xy + both.y * both.y * both.xx;
  const double shared = a.alpha * b.alpha * std::sqrt(det_a * det_b / det) * std::exp(-apart / (2 * det));
  const double ink_a = a.alpha * std::sqrt(det_a), ink_b = b.alpha * std::sqrt(det_b);
  return std::max(ink_a + ink_b - shared, std::max(ink_a, ink_b));
}

void merge_pair(const splatwizard::MergePairsArgs& args, int64_t row, int64_t gone) {
  Member members[2];
  const int64_t rows[2] = {row, gone};
  float* means = args.means + 3 * row;
  double unit = kLeast, total = 0;
  for (int i = 0; i < 2; ++i)
    for (int c = 0; c < 3; ++c) {
      members[i].offset[c] = double(args.means[3 * rows[i] + c]) - means[c];
      unit = std::max({unit, std::abs(members[i].offset[c]), double(args.scales[3 * rows[i] + c])});
    }
  for (int i = 0; i < 2; ++i) {
    Member& member = members[i];
    double scales[3], quat[4], norm = 0;
    for (int c = 0; c < 4; ++c) quat[c] = args.quats[4 * rows[i] + c], norm += quat[c] * quat[c];
    for (double& each : quat) each /= std::max(std::sqrt(norm), 1e-12);
    for (int c = 0; c < 3; ++c) scales[c] = args.scales[3 * rows[i] + c] / unit, member.offset[c] /= unit;
    half_covariance(quat, scales, member.half);
    member.alpha = args.opacities[rows[i]];
    member.mass = member.alpha * surface(scales[0], scales[1], scales[2]);
    total += member.mass;
  }
  double center[3];
  for (Member& member : members) member.share = total > 0 ? member.mass / std::max(total, kLeast) : .5;
  for (int c = 0; c < 3; ++c) {
    center[c] = members[1].share * members[1].offset[c];
    for (Member& member : members) member.offset[c] -= center[c];
  }
  Matrix found{}, axes;
  for (const Member& member : members)
    for (int i = 0; i < 3; ++i)
      for (int j = i; j < 3; ++j)
        found[i][j] += member.share * (row_product(member.half, i, j) + member.offset[i] * member.offset[j]);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < i; ++j) found[i][j] = found[j][i];
  double values[3], quat[4];
  principal_axes(found, values, axes);
  for (double& value : values) value = std::max(value, 0.);
  const double size = std::sqrt(values[1] * values[2]);
  const double opacity = size > 0 ? ink(members[0], members[1], axes) / std::max(size, kLeast)
                                  : std::max(members[0].alpha, members[1].alpha);
  quaternion(axes, quat);
  for (int c = 0; c < 3; ++c) {
    means[c] = float(means[c] + center[c] * unit);
    args.scales[3 * row + c] = float(std::sqrt(args.widen ? values[c] * std::max(opacity, 1.) : values[c]) * unit);
  }
  for (int c = 0; c < 4; ++c) args.quats[4 * row + c] = float(quat[c]);
  args.opacities[row] = float(std::min(std::max(opacity, 0.), 1.));
  float *kept = args.sh + row * args.width, *other = args.sh + gone * args.width;
  const float share = float(members[0].share), rest = float(members[1].share);
  for (int64_t i = 0; i < args.width; ++i) kept[i] = share * kept[i] + rest * other[i];
}

// What prices look at of a row, as float32 has it.
void tabulate(const splatwizard::MergePairsArgs& args, int64_t row) {
  constexpr float kBand0 = .28209479177387814f;
  float* to = args.table + kColumns * row;
  float scales[3], half[3][3];
  for (int c = 0; c < 3; ++c) {
    scales[c] = args.scales[3 * row + c] / args.unit;
    to[c] = (args.means[3 * row + c] - args.center[c]) / args.unit;
    to[12 + c] = .5f + kBand0 * args.sh[row * args.width + c];
  }
  half_covariance(args.quats + 4 * row, scales, half);
  int at = 3;
  for (int i = 0; i < 3; ++i)
    for (int j = i; j < 3; ++j) to[at++] = row_product(half, i, j);
  to[9] = scales[0] * scales[1] * scales[2];
  to[10] = args.opacities[row] * surface(scales[0], scales[1], scales[2]);
  to[11] = args.opacities[row];
}

}  // namespace

void merge_pairs(const splatwizard::MergePairsArgs& args, const splatwizard::Parallel& parallel) {
  parallel(args.n, 256, [&](int64_t first, int64_t last) {
    for (int64_t i = first; i < last; ++i) {
      merge_pair(args, args.pairs[2 * i], args.pairs[2 * i + 1]);
      tabulate(args, args.pairs[2 * i]);
    }
  });
}

}  // namespace SW_ARCH
