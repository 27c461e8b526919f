// Colours from codebooks: a pack of Gaussians at a time, whose coefficients are only ever in registers.
//
// The gradient of an entry is summed by one thread over its users in the order that the caller gives: the same bits
// for any number of threads. Users whose colour nobody saw are passed over: a mean in the camera's centre has no
// direction.
#include "shared_colors.h"

#include <algorithm>

#include "../sh.h"
#include "gather.h"
#include "parallel.h"

namespace SW_ARCH {
namespace {

constexpr int64_t kGaussians = 1024, kEntries = 32;  // that a thread takes at a time

template <class V>
struct SharedShader {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const SharedColors<S>& in;

  int basis_count() const { return (in.degree + 1) * (in.degree + 1); }

  // Direction from the camera; returns 1 / distance.
  V direction_of(const int32_t* gaussians, V* direction) const {
    gather_rows<V, 3>(in.means, 3, gaussians, direction);
    V squared = constant<V>(0);
    for (int j = 0; j < 3; ++j) direction[j] -= constant<V>(in.center[j]), squared += direction[j] * direction[j];
    const V inverse = constant<V>(1) / square_root(squared);
    for (int j = 0; j < 3; ++j) direction[j] *= inverse;
    return inverse;
  }

  // sh[3 k + channel]; room for a multiple of L behind the last one.
  void coefficients(const int32_t* gaussians, V* sh) const {
    alignas(64) int32_t rows[L];
    for (int i = 0; i < L; ++i) rows[i] = int32_t(in.rows[gaussians[i]]);
    V* to = sh + 3 * in.first;
    const auto take = [&](int fields) { gather_long_rows<V>(in.codebook, in.stride, rows, fields, to); };
    switch (3 * (basis_count() - in.first)) {  // constant row lengths
      case 3: take(3); break;
      case 9: take(9); break;
      case 12: take(12); break;
      case 24: take(24); break;
      case 27: take(27); break;
      case 45: take(45); break;
      case 48: take(48); break;
    }
    if (in.dc != nullptr) gather_rows<V, 3>(in.dc, 3, gaussians, sh);
  }

  void color_of(const V* sh, const V* basis, V* color) const {
    for (int c = 0; c < 3; ++c) color[c] = constant<V>(0.5);
    for (int k = 0; k < basis_count(); ++k)
      for (int c = 0; c < 3; ++c) color[c] += basis[k] * sh[3 * k + c];
  }

  void basis_of(const V* direction, V* basis) const {
    sh_basis(in.degree, direction[0], direction[1], direction[2], basis);
  }

  void forward(int64_t first, int64_t end, S* colors) const {
    alignas(64) int32_t gaussians[L];
    lane_rows<V>(first, end, gaussians);
    V direction[3] = {}, basis[kMaxBasis], sh[3 * kMaxBasis + L], color[3];
    coefficients(gaussians, sh);
    if (in.degree > 0) direction_of(gaussians, direction);
    basis_of(direction, basis);
    color_of(sh, basis, color);
    const V zero = constant<V>(0);
    if (in.clamp)
      for (V& x : color) x = select(x < zero, zero, x);
    scatter_rows<V, 3>(color, colors, 3, gaussians, int(std::min<int64_t>(end - first, L)));
  }

  void backward(int64_t first, int64_t end, const S* gradient, S* passed, S* means, S* dc) const {
    const int lanes = int(std::min<int64_t>(end - first, L));
    if (std::all_of(gradient + 3 * first, gradient + 3 * (first + lanes), [](S x) { return x == S(0); })) {
      for (S* to : {passed, means, dc})
        if (to != nullptr) std::fill(to + 3 * first, to + 3 * (first + lanes), S(0));
      return;
    }
    alignas(64) int32_t gaussians[L];
    lane_rows<V>(first, end, gaussians);
    const V zero = constant<V>(0);
    V direction[3] = {}, basis[kMaxBasis], sh[3 * kMaxBasis + L], color[3], g[3];
    V inverse = zero;
    gather_rows<V, 3>(gradient, 3, gaussians, g);
    coefficients(gaussians, sh);
    if (in.degree > 0) inverse = direction_of(gaussians, direction);
    basis_of(direction, basis);
    if (in.clamp) {
      color_of(sh, basis, color);
      for (int c = 0; c < 3; ++c) g[c] = select(color[c] < zero, zero, g[c]);
    }
    scatter_rows<V, 3>(g, passed, 3, gaussians, lanes);
    if (dc != nullptr) {
      V own[3];
      for (int c = 0; c < 3; ++c) own[c] = constant<V>(kSH0) * g[c];
      scatter_rows<V, 3>(own, dc, 3, gaussians, lanes);
    }
    V slope[3] = {zero, zero, zero};
    if (in.degree > 0) {
      V dx[kMaxBasis], dy[kMaxBasis], dz[kMaxBasis];
      sh_basis_gradient(in.degree, direction[0], direction[1], direction[2], dx, dy, dz);
      for (int k = 1; k < basis_count(); ++k) {
        const V weight = sh[3 * k] * g[0] + sh[3 * k + 1] * g[1] + sh[3 * k + 2] * g[2];
        slope[0] += dx[k] * weight, slope[1] += dy[k] * weight, slope[2] += dz[k] * weight;
      }
      const V radial = direction[0] * slope[0] + direction[1] * slope[1] + direction[2] * slope[2];
      const auto seen = maximum(maximum(absolute(g[0]), absolute(g[1])), absolute(g[2])) > zero;
      for (int j = 0; j < 3; ++j) slope[j] = select(seen, (slope[j] - direction[j] * radial) * inverse, zero);
    }
    scatter_rows<V, 3>(slope, means, 3, gaussians, lanes);
  }

  void entry(const int64_t* begin, const int64_t* end, const S* passed, S* row) const {
    const int fields = 3 * (basis_count() - in.first);
    V sums[3 * kMaxBasis + L];
    for (V& x : sums) x = constant<V>(0);
    alignas(64) int32_t users[L];
    int held = 0;
    for (const int64_t* at = begin; at != end; ++at) {
      const S* g = passed + 3 * *at;
      if (g[0] == S(0) && g[1] == S(0) && g[2] == S(0)) continue;
      users[held++] = int32_t(*at);
      if (held == L) add(users, held, passed, sums), held = 0;
    }
    if (held > 0) add(users, held, passed, sums);
    S totals[3 * kMaxBasis];
    lane_sums<V, 3 * kMaxBasis>(sums, totals);
    std::copy_n(totals, fields, row);
    std::fill(row + fields, row + in.stride, S(0));
  }

  void add(int32_t* users, int held, const S* passed, V* sums) const {
    for (int i = held; i < L; ++i) users[i] = users[held - 1];
    alignas(64) S gradient[3][L] = {};
    for (int i = 0; i < held; ++i)
      for (int c = 0; c < 3; ++c) gradient[c][i] = passed[3 * int64_t(users[i]) + c];
    V direction[3] = {}, basis[kMaxBasis];
    if (in.degree > 0) direction_of(users, direction);
    basis_of(direction, basis);
    for (int k = in.first; k < basis_count(); ++k)
      for (int c = 0; c < 3; ++c) sums[3 * (k - in.first) + c] += basis[k] * load<V>(gradient[c]);
  }
};

template <class V, class Body>
void for_packs(const SharedColors<Scalar<V>>& in, const Body& body) {
  parallel_dynamic(in.parallel, (in.count + kGaussians - 1) / kGaussians, [&](int64_t chunk) {
    const int64_t end = std::min((chunk + 1) * kGaussians, in.count);
    for (int64_t first = chunk * kGaussians; first < end; first += lanes_of<V>) body(first, end);
  });
}

template <class V>
void codebook_of(const SharedColors<Scalar<V>>& in, const int64_t* order, const int64_t* offsets,
                 const Scalar<V>* passed, Scalar<V>* codebook) {
  const SharedShader<V> shader{in};
  parallel_dynamic(in.parallel, (in.entries + kEntries - 1) / kEntries, [&](int64_t chunk) {
    const int64_t end = std::min((chunk + 1) * kEntries, in.entries);
    for (int64_t m = chunk * kEntries; m < end; ++m)
      shader.entry(order + offsets[m], order + offsets[m + 1], passed, codebook + m * in.stride);
  });
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                         \
  template <>                                                                                                        \
  void shade_shared<S>(const SharedColors<S>& in, S* colors) {                                                       \
    const SharedShader<V> shader{in};                                                                                \
    for_packs<V>(in, [&](int64_t first, int64_t end) { shader.forward(first, end, colors); });                       \
  }                                                                                                                  \
  template <>                                                                                                        \
  void shade_shared_backward<S>(const SharedColors<S>& in, const S* gradient, S* passed, S* means, S* dc) {          \
    const SharedShader<V> shader{in};                                                                                \
    for_packs<V>(in, [&](int64_t first, int64_t end) { shader.backward(first, end, gradient, passed, means, dc); }); \
  }                                                                                                                  \
  template <>                                                                                                        \
  void add_to_codebook<S>(const SharedColors<S>& in, const int64_t* order, const int64_t* offsets,                   \
                          const S* passed, S* codebook) {                                                            \
    codebook_of<V>(in, order, offsets, passed, codebook);                                                            \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
