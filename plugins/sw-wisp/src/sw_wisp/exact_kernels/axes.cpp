// Axes of splats by the cyclic Jacobi method, as sw_wisp.shape has them.
#include <algorithm>
#include <cfloat>
#include <cmath>

#include "ties_face.h"

namespace {

using namespace splatwizard;

constexpr int SWEEPS = 5;

// Eigenvalues on the diagonal of m, and their vectors in the columns of axes.
void jacobi(double (&m)[3][3], double (&axes)[3][3]) {
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) axes[i][j] = i == j;
  constexpr int pairs[3][2] = {{0, 1}, {0, 2}, {1, 2}};
  for (int sweep = 0; sweep < SWEEPS; ++sweep)
    for (const auto& [p, q] : pairs) {
      const int r = 3 - p - q;
      const double twice = 2 * m[p][q], apart = m[q][q] - m[p][p];
      const double t = twice / (apart + std::copysign(std::hypot(apart, twice) + DBL_MIN, apart));
      const double c = 1 / std::sqrt(1 + t * t), s = t * c, shift = t * m[p][q];
      m[p][p] -= shift;
      m[q][q] += shift;
      const double pr = m[p][r], qr = m[q][r];
      m[p][r] = m[r][p] = c * pr - s * qr;
      m[q][r] = m[r][q] = s * pr + c * qr;
      m[p][q] = m[q][p] = 0;
      for (auto& row : axes) {
        const double along_p = row[p], along_q = row[q];
        row[p] = c * along_p - s * along_q;
        row[q] = s * along_p + c * along_q;
      }
    }
}

// The quaternion of a rotation. Squares of 2w, 2x, 2y, 2z: the largest is at least 1, so dividing by its root is safe.
void quaternion(const double (&r)[3][3], double* found) {
  const double xx = r[0][0], yy = r[1][1], zz = r[2][2];
  const double wx = r[2][1] - r[1][2], wy = r[0][2] - r[2][0], wz = r[1][0] - r[0][1];
  const double xy = r[0][1] + r[1][0], xz = r[0][2] + r[2][0], yz = r[1][2] + r[2][1];
  const double rows[4][4] = {{1 + xx + yy + zz, wx, wy, wz},
                             {wx, 1 + xx - yy - zz, xy, xz},
                             {wy, xy, 1 - xx + yy - zz, yz},
                             {wz, xz, yz, 1 - xx - yy + zz}};
  int best = 0;
  for (int i = 1; i < 4; ++i)
    if (rows[i][i] > rows[best][best]) best = i;
  double norm = 0;
  for (double each : rows[best]) norm += each * each;
  const double scale = (rows[best][0] < 0 ? -1 : 1) / std::max(std::sqrt(norm), 1e-12);
  for (int i = 0; i < 4; ++i) found[i] = scale * rows[best][i];
}

}  // namespace

SW_OPERATION(sw_wisp_exact, axes) {
  return guarded(call, [&](const Parallel& parallel) {
    const auto& a = *call;
    parallel(a.n, 1024, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        const double* const six = a.six + 6 * i;
        double m[3][3] = {{six[0], six[1], six[2]}, {six[1], six[3], six[4]}, {six[2], six[4], six[5]}};
        double axes[3][3], rotation[3][3];
        jacobi(m, axes);
        int order[3] = {0, 1, 2};
        std::stable_sort(order, order + 3, [&](int one, int other) { return m[one][one] < m[other][other]; });
        for (int j = 0; j < 3; ++j) {
          a.log_scales[3 * i + j] = m[order[j]][order[j]];
          for (int k = 0; k < 3; ++k) rotation[k][j] = axes[k][order[j]];
        }
        const auto& r = rotation;
        const double det = r[0][0] * (r[1][1] * r[2][2] - r[1][2] * r[2][1]) -
                           r[0][1] * (r[1][0] * r[2][2] - r[1][2] * r[2][0]) +
                           r[0][2] * (r[1][0] * r[2][1] - r[1][1] * r[2][0]);
        if (det < 0)
          for (auto& row : rotation)
            for (double& each : row) each = -each;
        quaternion(rotation, a.quats + 4 * i);
      }
    });
  });
}
