// Gaussians of decoded integers: floats, the same as Python's to about 1e-6.
#include <cmath>

#include "model.h"
#include "wisp.h"

namespace swz {

namespace {

constexpr double C0 = 0.28209479177387814, ROOT_2 = 1.4142135623730951, ROOT_6 = 2.449489742783178;
constexpr double HALF_PI = 1.5707963267948966, SMALLEST = 2.2250738585072014e-308;
constexpr int64_t COLOURS = 3, SWEEPS = 5;

int group_of(int64_t column) { return column < 1 ? 0 : column < 6 ? 1 : column < 7 ? 2 : column < 10 ? 3 : 4; }

// From the middle of a cell of this width to the mean of a centred Gaussian within it, in steps; middle > 0.
double to_centroid(double middle, double sigma, double width) {
  const double low = (middle - width / 2) / sigma, high = (middle + width / 2) / sigma;
  const double mass = (std::erfc(low / ROOT_2) - std::erfc(high / ROOT_2)) * std::sqrt(HALF_PI);
  if (!(mass > 1e-280)) return -width / 2;
  return sigma * (std::exp(-low * low / 2) - std::exp(-high * high / 2)) / mass - middle;
}

// Values of the numbers, in their own units.
struct Values {
  static constexpr int64_t USUAL = 64;
  const Splats& splats;
  const Appearance& looks;
  const ExactTables& tables;
  Buffer<double> seen;  // [3, 64, 64] offsets of small indices, NaN: not yet

  Values(const Splats& all, const Appearance& how, const ExactTables& exact)
      : splats(all), looks(how), tables(exact), seen(3 * 64 * USUAL) {
    std::memset(seen.data, 255, sizeof(double) * static_cast<size_t>(seen.size));
  }
  double offset(int64_t size, int64_t table, int64_t missing) {
    static constexpr double WIDTHS[] = {1, 3, 9};
    const auto found = [&] { return to_centroid(static_cast<double>(size), tables.scales[table], WIDTHS[missing]); };
    if (size >= USUAL) return found();
    double& kept = seen[(64 * missing + table) * USUAL + size];
    if (std::isnan(kept)) kept = found();
    return kept;
  }
  void put(int64_t row, float* to) {
    for (int64_t c = 0; c < NUMBERS; ++c) {
      const int64_t at = NUMBERS * row + c, k = splats.index[at];
      const bool refined = c >= REFINED.first && c < REFINED.end;
      const int64_t missing = refined ? splats.missing[row] : 0;
      const int strength = c >= LATENTS.first && !splats.has_view[row] ? 0 : looks.strengths[missing][group_of(c)];
      auto units = static_cast<double>(splats.unit(row, c));
      if (strength && k) {
        const double by = offset(k < 0 ? -k : k, table_of(splats.scale[at], 0), missing);
        units += strength / 255.0 * splats.multiplier[at] * (k < 0 ? -by : by);
      }
      to[c] = static_cast<float>(units * (looks.base_steps[c] / UNIT));
    }
  }
};

// Eigenvalues and, in columns, eigenvectors of a symmetric matrix: cyclic Jacobi.
void diagonalise(double m[3][3], double vectors[3][3]) {
  for (int i = 0; i < 3; ++i)
    for (int k = 0; k < 3; ++k) vectors[i][k] = i == k;
  for (int sweep = 0; sweep < SWEEPS; ++sweep)
    for (const int r : {2, 1, 0}) {
      const int p = r == 0 ? 1 : 0, q = r == 2 ? 1 : 2;
      const double twice = 2 * m[p][q], apart = m[q][q] - m[p][p];
      const double t = twice / (apart + std::copysign(std::sqrt(apart * apart + twice * twice) + SMALLEST, apart));
      const double c = 1 / std::sqrt(1 + t * t), s = t * c, shift = t * m[p][q];
      m[p][p] -= shift, m[q][q] += shift;
      const double pr = m[p][r], qr = m[q][r];
      m[p][r] = m[r][p] = c * pr - s * qr;
      m[q][r] = m[r][q] = s * pr + c * qr;
      m[p][q] = m[q][p] = 0;
      for (int i = 0; i < 3; ++i) {
        const double a = vectors[i][p], b = vectors[i][q];
        vectors[i][p] = c * a - s * b, vectors[i][q] = s * a + c * b;
      }
    }
}

// A unit quaternion w, x, y, z of a rotation, w >= 0.
void put_quaternion(const double r[3][3], float* to) {
  const double xx = r[0][0], yy = r[1][1], zz = r[2][2];
  const double squares[4] = {1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz};
  const double wx = r[2][1] - r[1][2], wy = r[0][2] - r[2][0], wz = r[1][0] - r[0][1];
  const double xy = r[0][1] + r[1][0], xz = r[0][2] + r[2][0], yz = r[1][2] + r[2][1];
  const double products[4][4] = {{squares[0], wx, wy, wz}, {wx, squares[1], xy, xz}, {wy, xy, squares[2], yz},
                                 {wz, xz, yz, squares[3]}};
  int best = 0;
  for (int i = 1; i < 4; ++i) best = squares[i] > squares[best] ? i : best;
  const double* q = products[best];
  const double norm = std::sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]), sign = q[0] < 0 ? -1 : 1;
  for (int i = 0; i < 4; ++i) to[i] = static_cast<float>(sign * q[i] / norm);
}

void put_shape(const float* shape, double size, double thinnest, double thickest, float* scales, float* quat) {
  const double d[5] = {shape[0], shape[1], shape[2], shape[3], shape[4]};
  const double zz = 2 * d[1] / ROOT_6, mean = -d[1] / ROOT_6, half = d[0] / ROOT_2;
  double m[3][3] = {{mean + half + size, d[2] / ROOT_2, d[3] / ROOT_2}, {0, mean - half + size, d[4] / ROOT_2},
                    {0, 0, zz + size}};
  m[1][0] = m[0][1], m[2][0] = m[0][2], m[2][1] = m[1][2];
  double axes[3][3], sorted[3][3];
  diagonalise(m, axes);
  int order[3] = {0, 1, 2};
  for (const int i : {0, 1, 0})
    if (m[order[i + 1]][order[i + 1]] < m[order[i]][order[i]]) {
      const int other = order[i];
      order[i] = order[i + 1], order[i + 1] = other;
    }
  for (int k = 0; k < 3; ++k) {
    const double value = m[order[k]][order[k]];
    scales[k] = static_cast<float>(value < thinnest ? thinnest : value > thickest ? thickest : value);
    for (int i = 0; i < 3; ++i) sorted[i][k] = axes[i][order[k]];
  }
  const auto& a = sorted;
  const double det = a[0][0] * (a[1][1] * a[2][2] - a[1][2] * a[2][1]) - a[0][1] * (a[1][0] * a[2][2] - a[1][2] * a[2][0]) +
                     a[0][2] * (a[1][0] * a[2][1] - a[1][1] * a[2][0]);
  for (auto& row : sorted)
    for (double& each : row) each *= det < 0 ? -1 : 1;
  put_quaternion(sorted, quat);
}

Buffer<float> floats(const EightBitLayer& layer) {
  Buffer<float> found(layer.outputs * layer.inputs);
  for (int64_t i = 0; i < found.size; ++i)
    found[i] = static_cast<float>(layer.weight(i / layer.inputs, i % layer.inputs));
  return found;
}

}  // namespace

void put_gaussians(const Splats& splats, const Appearance& looks, const ExactTables& tables) {
  const EightBitLayer &basis = looks.basis, &hidden = looks.hidden, &last = looks.last;
  const int64_t outputs = 3 * looks.sh_degree * (looks.sh_degree + 2), latents = LATENTS.width();
  if (basis.outputs != outputs || basis.inputs != latents || hidden.inputs != latents + COLOURS ||
      last.outputs != outputs || last.inputs != hidden.outputs)
    refuse("no appearance network has layers (", basis.outputs, ", ", basis.inputs, "), (", hidden.outputs, ", ",
           hidden.inputs, "), (", last.outputs, ", ", last.inputs, ")");
  const Buffer<float> b = floats(basis), w1 = floats(hidden), w2 = floats(last);
  Buffer<float> inner(hidden.outputs);
  Values values(splats, looks, tables);
  const Gaussians to(splats.count, looks.sh_degree, 3);
  const double log_edge = std::log(looks.edge), thinnest = std::log(1e-6 * looks.edge);
  for (int64_t row = 0; row < splats.count; ++row) {
    float number[NUMBERS];
    values.put(row, number);
    const int64_t level = splats.levels[row];
    const double edge = looks.edge / static_cast<double>(int64_t{1} << level);
    for (int axis = 0; axis < 3; ++axis) {
      int64_t cell = 0;
      for (int64_t bit = 0; bit < level; ++bit) cell |= (splats.codes[row] >> (3 * bit + axis) & 1) << bit;
      to.means[3 * row + axis] = static_cast<float>(looks.low[axis] + (static_cast<double>(cell) + 0.5) * edge);
    }
    to.opacity_logits[row] = number[0];
    const auto own = static_cast<float>(log_edge - 0.6931471805599453 * static_cast<double>(level));
    put_shape(number + 1, number[6] + own, thinnest, log_edge, to.log_scales + 3 * row, to.quats + 4 * row);
    const double y = number[7] / std::sqrt(3.0), c1 = number[8] / ROOT_2, c2 = number[9] / ROOT_6;
    const double rgb[3] = {y + c1 - c2, y + 2 * c2, y - c1 - c2};
    for (int c = 0; c < 3; ++c) to.sh_dc[3 * row + c] = static_cast<float>((rgb[c] - 0.5) / C0);
    for (int64_t i = 0; i < hidden.outputs; ++i) {
      const float* w = w1.data + hidden.inputs * i;
      auto sum = static_cast<float>(hidden.bias(i));
      for (int64_t k = 0; k < latents; ++k) sum += w[k] * number[LATENTS.first + k];
      for (int64_t k = 0; k < COLOURS; ++k) sum += w[latents + k] * number[7 + k];
      inner[i] = sum > 0 ? sum : 0;
    }
    for (int64_t i = 0; i < outputs; ++i) {
      auto sum = static_cast<float>(last.bias(i));
      for (int64_t k = 0; k < last.inputs; ++k) sum += w2[last.inputs * i + k] * inner[k];
      for (int64_t k = 0; k < latents; ++k) sum += b[latents * i + k] * number[LATENTS.first + k];
      to.sh_rest[outputs * row + i] = sum;
    }
  }
  decoded.check_finite();
}

}  // namespace swz
