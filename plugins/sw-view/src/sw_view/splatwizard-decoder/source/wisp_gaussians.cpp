// Gaussians of decoded integers: floats, the same as Python's to about 1e-6.
#include <cmath>

#include "model.h"
#include "wisp.h"

namespace swz {

namespace {

constexpr double C0 = 0.28209479177387814, ROOT_2 = 1.4142135623730951, ROOT_6 = 2.449489742783178;
constexpr double HALF_PI = 1.5707963267948966, SMALLEST = 2.2250738585072014e-308;
constexpr double NO_ANGLE = 1e-18;  // radians that turn no float64
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
      if (std::fabs(twice) <= NO_ANGLE * std::fabs(apart)) continue;  // mostly from the third sweep on
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

// Every third bit of a Morton code, from the lowest on.
int64_t every_third(int64_t code) {
  auto x = static_cast<uint64_t>(code) & 0x1249249249249249;
  x = (x | x >> 2) & 0x10c30c30c30c30c3;
  x = (x | x >> 4) & 0x100f00f00f00f00f;
  x = (x | x >> 8) & 0x1f0000ff0000ff;
  x = (x | x >> 16) & 0x1f00000000ffff;
  return static_cast<int64_t>((x | x >> 32) & 0x1fffff);
}

typedef float Four __attribute__((vector_size(16)));
typedef float FourLoad __attribute__((vector_size(16), aligned(4)));
constexpr int64_t WIDE = 4, AT_ONCE = 4 * WIDE;  // outputs whose sums are kept in registers

// A layer as [inputs, padded outputs].
struct Turned {
  int64_t inputs, outputs, padded;
  Buffer<float> weights, bias;

  explicit Turned(const EightBitLayer& layer)
      : inputs(layer.inputs), outputs(layer.outputs), padded((outputs + AT_ONCE - 1) / AT_ONCE * AT_ONCE),
        weights(inputs * padded), bias(padded) {
    weights.clear(), bias.clear();
    for (int64_t i = 0; i < outputs; ++i) {
      bias[i] = static_cast<float>(layer.bias(i));
      for (int64_t k = 0; k < inputs; ++k) weights[padded * k + i] = static_cast<float>(layer.weight(i, k));
    }
  }
  // Adds products of inputs `first` and on to some sums.
  [[gnu::always_inline]] void add(int64_t output, int64_t first, const float* in, int64_t count, Four* sum) const {
    const float* w = weights.data + padded * first + output;
    for (int64_t k = 0; k < count; ++k, w += padded)
#pragma GCC unroll 4
      for (int64_t v = 0; v < WIDE; ++v) sum[v] += *reinterpret_cast<const FourLoad*>(w + 4 * v) * (Four{} + in[k]);
  }
  [[gnu::always_inline]] void begin(int64_t output, Four* sum) const {
#pragma GCC unroll 4
    for (int64_t v = 0; v < WIDE; ++v) sum[v] = *reinterpret_cast<const FourLoad*>(bias.data + output + 4 * v);
  }
};

void put_four(float* to, Four x) { *reinterpret_cast<FourLoad*>(to) = x; }

// What puts Gaussians. Some rows a call: an engine takes its better code for a function at the next call of it.
struct Painter {
  Values values;
  const Splats& splats;
  const Appearance& looks;
  const Gaussians& to;
  Turned basis, hidden, last;
  Buffer<float> inner, rest;
  double log_edge, thinnest;

  Painter(const Splats& all, const Appearance& how, const ExactTables& tables, const Gaussians& target)
      : values(all, how, tables), splats(all), looks(how), to(target), basis(how.basis), hidden(how.hidden),
        last(how.last), inner(hidden.padded), rest(last.padded), log_edge(std::log(how.edge)),
        thinnest(std::log(1e-6 * how.edge)) {}

  [[gnu::noinline]] void put(int64_t begin, int64_t end, bool has_base) {
    for (int64_t row = begin; row < end; ++row) {
      float number[NUMBERS];
      values.put(row, number);
      if (!has_base) put_base(row, number);
      put_harmonics(row, number);
    }
  }
  void put_base(int64_t row, const float* number) const {
    const int64_t level = splats.levels[row];
    const double edge = looks.edge / static_cast<double>(int64_t{1} << level);
    for (int axis = 0; axis < 3; ++axis) {
      const auto cell = static_cast<double>(every_third(splats.codes[row] >> axis));
      to.means[3 * row + axis] = static_cast<float>(looks.low[axis] + (cell + 0.5) * edge);
    }
    to.opacity_logits[row] = number[0];
    const auto own = static_cast<float>(log_edge - 0.6931471805599453 * static_cast<double>(level));
    put_shape(number + 1, number[6] + own, thinnest, log_edge, to.log_scales + 3 * row, to.quats + 4 * row);
    const double y = number[7] / std::sqrt(3.0), c1 = number[8] / ROOT_2, c2 = number[9] / ROOT_6;
    const double rgb[3] = {y + c1 - c2, y + 2 * c2, y - c1 - c2};
    for (int c = 0; c < 3; ++c) to.sh_dc[3 * row + c] = static_cast<float>((rgb[c] - 0.5) / C0);
  }
  void put_harmonics(int64_t row, const float* number) const {
    const int64_t latents = LATENTS.width();
    Four sum[WIDE];
    for (int64_t i = 0; i < hidden.padded; i += AT_ONCE) {
      hidden.begin(i, sum);
      hidden.add(i, 0, number + LATENTS.first, latents, sum);
      hidden.add(i, latents, number + 7, COLOURS, sum);
#pragma GCC unroll 4
      for (int64_t v = 0; v < WIDE; ++v) put_four(inner.data + i + 4 * v, sum[v] > 0 ? sum[v] : Four{});
    }
    for (int64_t i = 0; i < last.padded; i += AT_ONCE) {
      last.begin(i, sum);
      last.add(i, 0, inner.data, last.inputs, sum);
      basis.add(i, 0, number + LATENTS.first, latents, sum);
#pragma GCC unroll 4
      for (int64_t v = 0; v < WIDE; ++v) put_four(rest.data + i + 4 * v, sum[v]);
    }
    std::memcpy(to.sh_rest + last.outputs * row, rest.data, sizeof(float) * static_cast<size_t>(last.outputs));
  }
};

}  // namespace

void put_gaussians(const Splats& splats, const Appearance& looks, const ExactTables& tables, bool has_base) {
  const EightBitLayer &basis = looks.basis, &hidden = looks.hidden, &last = looks.last;
  const int64_t outputs = 3 * looks.sh_degree * (looks.sh_degree + 2), latents = LATENTS.width();
  if (basis.outputs != outputs || basis.inputs != latents || hidden.inputs != latents + COLOURS ||
      last.outputs != outputs || last.inputs != hidden.outputs)
    refuse("no appearance network has layers (", basis.outputs, ", ", basis.inputs, "), (", hidden.outputs, ", ",
           hidden.inputs, "), (", last.outputs, ", ", last.inputs, ")");
  static Gaussians to;
  if (!has_base) {
    decoded.clear();  // of the packets before
    to = Gaussians(splats.count, looks.sh_degree, 3);
  }
  Painter painter(splats, looks, tables, to);
  constexpr int64_t SOME = 256;
  for (int64_t row = 0; row < splats.count; row += SOME)
    painter.put(row, row + SOME < splats.count ? row + SOME : splats.count, has_base);
  decoded.check_finite();
}

}  // namespace swz
