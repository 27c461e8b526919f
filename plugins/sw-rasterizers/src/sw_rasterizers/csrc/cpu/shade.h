// Colours of the drawn splats, a pack of slots at a time, and the way back from dL/dcolour.
//
// d colour / d position is kept, so that the backward pass does not read the coefficients again.
#pragma once

#include <algorithm>

#include "../rotation.h"
#include "../sh.h"
#include "gather.h"
#include "kernels.h"

namespace SW_ARCH {

// Asks for the coefficients of a Gaussian as soon as it is known to be drawn; they arrive while others are projected.
template <class S>
SW_HD void prefetch_sh_rest(const Gaussians<S>& g, int64_t n) {
  if (g.sh_dc == nullptr || g.sh_degree == 0) return;
  constexpr int kLine = 64 / sizeof(S);
  const S* row = g.sh_rest + n * g.sh_rest_stride;
  const int fields = 3 * ((g.sh_degree + 1) * (g.sh_degree + 1) - 1);
  for (int k = 0; k < fields; k += kLine) __builtin_prefetch(row + k, 0, 2);
  __builtin_prefetch(row + fields - 1, 0, 2);
}

template <class V>
struct Shader {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const View<S>& view;
  const Gaussians<S>& g;
  const Settings& settings;
  const Slots<S>& slots;

  // Colours of the slots begin..end into their records.
  void color(int64_t begin, int64_t end) const {
    if (g.sh_dc != nullptr)
      for (int64_t s = begin; s < end; s += L) shade_pack(s, end);
    if (g.colors != nullptr) copy_colors(begin, end);
  }

  // Drops the slots whose colours (or further channels, so many a row) are not finite; returns how many.
  int64_t drop_broken(int64_t begin, int64_t end, int channels, int32_t* radii) const {
    int64_t dropped = 0;
    for (int64_t s = begin; s < end; ++s)
      if (!has_finite_colors(s, channels)) {
        drop(s, radii);
        ++dropped;
      }
    return dropped;
  }

 private:
  void shade_pack(int64_t first, int64_t end) const {
    const auto c = [](double value) { return constant<V>(value); };
    const int lanes = int(end - first < L ? end - first : L);
    alignas(64) int32_t rows[L];
    for (int i = 0; i < L; ++i) rows[i] = slots.index[first + (i < lanes ? i : lanes - 1)];
    const int degree = g.sh_degree, basis_count = (degree + 1) * (degree + 1);

    V dc[3], color[3];
    gather_rows<V, 3>(g.sh_dc, g.sh_dc_stride, rows, dc);
    for (int k = 0; k < 3; ++k) color[k] = c(0.5) + c(kSH0) * dc[k];
    V slope[9];
    for (V& x : slope) x = c(0);
    if (degree > 0) {
      V rest[3 * kMaxBasis];
      gather_sh_rest(degree, rows, rest);
      const V* sh = rest - 3;  // sh[3 k + channel]
      V direction[3], basis[kMaxBasis];
      gather_rows<V, 3>(g.means, 3, rows, direction);
      for (int j = 0; j < 3; ++j) direction[j] -= view.center[j];
      const V inverse_length = c(1) / square_root(dot3(direction, direction));
      for (V& d : direction) d *= inverse_length;
      sh_basis(degree, direction[0], direction[1], direction[2], basis);
      for (int k = 1; k < basis_count; ++k)
        for (int channel = 0; channel < 3; ++channel) color[channel] += basis[k] * sh[3 * k + channel];
      if (slots.color_slope != nullptr) {
        V dx[kMaxBasis], dy[kMaxBasis], dz[kMaxBasis];
        sh_basis_gradient(degree, direction[0], direction[1], direction[2], dx, dy, dz);
        for (int k = 1; k < basis_count; ++k)
          for (int channel = 0; channel < 3; ++channel) {
            slope[3 * channel] += dx[k] * sh[3 * k + channel];
            slope[3 * channel + 1] += dy[k] * sh[3 * k + channel];
            slope[3 * channel + 2] += dz[k] * sh[3 * k + channel];
          }
        for (int channel = 0; channel < 3; ++channel) {  // the direction is a unit vector
          V* s = slope + 3 * channel;
          const V radial = dot3(direction, s);
          for (int j = 0; j < 3; ++j) s[j] = (s[j] - direction[j] * radial) * inverse_length;
        }
      }
    }
    alignas(64) S out[3][L];
    for (int k = 0; k < 3; ++k) store(out[k], color[k]);
    for (int i = 0; i < lanes; ++i) {
      S* record = slots.records + (first + i) * kRecord;
      int clamped = 0;
      for (int k = 0; k < 3; ++k) {
        const bool below = settings.clamp_color && out[k][i] < S(0);
        clamped |= int(below) << k;
        record[kRed + k] = below ? S(0) : out[k][i];
      }
      slots.clamped[first + i] = uint8_t(clamped);
    }
    if (slots.color_slope != nullptr) {
      alignas(64) int32_t targets[L];
      for (int i = 0; i < L; ++i) targets[i] = int32_t(first + i);
      scatter_rows<V, 9>(slope, slots.color_slope, 9, targets, lanes);
    }
  }

  // Constant row lengths: the tails become plain stores.
  SW_HD void gather_sh_rest(int degree, const int32_t* rows, V* rest) const {
    if (degree == 1) gather_long_rows<V>(g.sh_rest, g.sh_rest_stride, rows, 9, rest);
    if (degree == 2) gather_long_rows<V>(g.sh_rest, g.sh_rest_stride, rows, 24, rest);
    if (degree == 3) gather_long_rows<V>(g.sh_rest, g.sh_rest_stride, rows, 45, rest);
  }

  void copy_colors(int64_t begin, int64_t end) const {
    for (int64_t s = begin; s < end; ++s) {
      slots.clamped[s] = 0;
      if (g.color_channels != 3) continue;
      for (int k = 0; k < 3; ++k) slots.records[s * kRecord + kRed + k] = g.colors[slots.index[s] * int64_t(3) + k];
    }
  }

  bool has_finite_colors(int64_t slot, int channels) const {
    const S* record = slots.records + slot * kRecord;
    S probe = finite_probe(record[kRed]) + finite_probe(record[kGreen]) + finite_probe(record[kBlue]);
    for (int k = 0; k < channels; ++k) probe += finite_probe(slots.channels[slot * channels + k]);
    if (slots.color_slope != nullptr)
      for (int k = 0; k < 9; ++k) probe += finite_probe(slots.color_slope[slot * 9 + k]);
    return probe == S(0);
  }

  // Turns a slot into one that touches no tile and passes no gradient on.
  void drop(int64_t slot, int32_t* radii) const {
    radii[slots.index[slot]] = 0;
    slots.run[slot].count = 0;
    slots.clamped[slot] = 7;
    if (slots.color_slope != nullptr) std::fill_n(slots.color_slope + slot * 9, 9, S(0));
  }
};

// dL/dsh_k = B_k dL/dcolour, and the colour's part of dL/dmean through the viewing direction.
template <class V>
struct ColorBackward {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const View<S>& view;
  const Gaussians<S>& g;
  const Slots<S>& slots;
  const Gradients<S>& out;

  // `gradient`: dL/dcolour of the slots first..first + lanes, one row a channel; `mean_gradient` is added to.
  void operator()(int64_t first, int lanes, const int32_t* rows, const V* mean, S (*gradient)[L],
                  V* mean_gradient) const {
    alignas(64) S color[3][L];
    for (int k = 0; k < 3; ++k)
      for (int i = 0; i < L; ++i) {
        const bool clamped = i >= lanes || (slots.clamped[first + i] >> k & 1) != 0;
        color[k][i] = clamped ? S(0) : gradient[k][i];
      }
    if (out.sh_dc != nullptr)
      for (int i = 0; i < lanes; ++i)
        for (int k = 0; k < 3; ++k) out.sh_dc[rows[i] * out.sh_dc_stride + k] = S(kSH0) * color[k][i];
    if (g.sh_degree == 0) return;
    if (out.means != nullptr) {
      alignas(64) int32_t targets[L];
      for (int i = 0; i < L; ++i) targets[i] = int32_t(first + (i < lanes ? i : lanes - 1));
      V slope[9];
      gather_rows<V, 9>(slots.color_slope, 9, targets, slope);
      for (int k = 0; k < 3; ++k)
        for (int j = 0; j < 3; ++j) mean_gradient[j] += load<V>(color[k]) * slope[3 * k + j];
    }
    if (out.sh_rest == nullptr) return;
    V direction[3], basis[kMaxBasis] = {};
    for (int j = 0; j < 3; ++j) direction[j] = mean[j] - view.center[j];
    const V inverse_length = constant<V>(1) / square_root(dot3(direction, direction));
    for (V& d : direction) d *= inverse_length;
    sh_basis(g.sh_degree, direction[0], direction[1], direction[2], basis);
    V values[3 * kMaxBasis];
    const int count = (g.sh_degree + 1) * (g.sh_degree + 1);
    for (int k = 1; k < count; ++k)
      for (int channel = 0; channel < 3; ++channel) values[3 * (k - 1) + channel] = basis[k] * load<V>(color[channel]);
    const auto write = [&](int fields) {
      scatter_long_rows(values, fields, out.sh_rest, out.sh_rest_stride, rows, lanes);
    };
    if (g.sh_degree == 1) write(9);  // constant row lengths: the tails become plain stores
    if (g.sh_degree == 2) write(24);
    if (g.sh_degree == 3) write(45);
  }
};

}  // namespace SW_ARCH
