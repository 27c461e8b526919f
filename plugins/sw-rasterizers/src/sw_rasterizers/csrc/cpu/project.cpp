// Projection: culls, projects and colours the Gaussians, a pack of them at a time.
//
// A thread takes kChunk Gaussians. What is drawn gets a slot; the slots of a chunk are compact and start at the chunk's
// first index, so that slots ascend with the Gaussian index without a second pass. Colours are evaluated for
// slots only: their coefficients, three quarters of all input bytes, are not even read for the culled ones.
#include <algorithm>

#include "../projection.h"
#include "../sh.h"
#include "../tiles.h"
#include "gather.h"
#include "kernels.h"
#include "parallel.h"

namespace SW_ARCH {
namespace {

// The pixel test alone decides what is drawn; boxes and tiles are chosen on a slightly larger ellipse, so that its
// rounding never shows.
constexpr double kCutoffScale = 1.001, kCutoffShift = 1e-3;

template <class V, bool kCov3d>
struct Projector {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const View<S>& view;
  const Gaussians<S>& g;
  const Settings& settings;

  // Projects rows[0..L); returns the mask of those inside the depth range with meaningful values.
  auto run(const int32_t* rows, Projection<V>& p, V& opacity, V& finite) const {
    Geometry<V> in;
    gather_rows<V, 3>(g.means, 3, rows, in.mean);
    V probe = finite_probe(in.mean[0]) + finite_probe(in.mean[1]) + finite_probe(in.mean[2]);
    if constexpr (kCov3d) {
      gather_rows<V, 6>(g.cov3d, 6, rows, in.cov);
      for (const V& x : in.cov) probe += finite_probe(x);
    } else {
      gather_rows<V, 3>(g.scales, 3, rows, in.scale);
      gather_rows<V, 4>(g.quats, 4, rows, in.quat);
      for (const V& x : in.scale) probe += finite_probe(x);
      for (const V& x : in.quat) probe += finite_probe(x);
    }
    opacity = constant<V>(1);
    if (g.opacities != nullptr) gather_rows<V, 1>(g.opacities, 1, rows, &opacity);
    probe += finite_probe(opacity);
    project<kCov3d>(view, S(settings.scale_modifier), S(settings.eps2d), settings.antialias, in, p);
    finite = probe;
    const V zero = constant<V>(0);
    const V derived = finite_probe(p.u) + finite_probe(p.v) + finite_probe(p.det) + finite_probe(p.ka) +
                      finite_probe(p.kb) + finite_probe(p.kc);
    return (probe == zero) & (derived == zero) & (p.t[2] > constant<V>(view.near)) & (p.t[2] < constant<V>(view.far)) &
           (p.det > zero) & (p.c00 > zero) & (p.c11 > zero) & (opacity >= zero);
  }
};

template <class V>
SW_HD void lane_rows(int64_t first, int64_t end, int32_t* rows) {
  for (int i = 0; i < lanes_of<V>; ++i) rows[i] = int32_t(first + i < end ? first + i : end - 1);
}

template <class V, bool kCov3d>
struct ChunkProjection : Projector<V, kCov3d> {
  using S = Scalar<V>;
  using Base = Projector<V, kCov3d>;
  static constexpr int L = lanes_of<V>;
  const Channels& channels;
  const Slots<S>& slots;
  int32_t* radii;

  void operator()(int64_t chunk, int64_t* invalid) const {
    const auto& g = this->g;
    const int64_t begin = chunk * kChunk, end = begin + kChunk < g.count ? begin + kChunk : g.count;
    int64_t slot = begin;
    for (int64_t first = begin; first < end; first += L) slot = project_pack(first, end, slot, invalid);
    const int64_t used = slot - begin;
    slots.per_chunk[chunk] = int32_t(used);
    if (g.sh_dc != nullptr)
      for (int64_t s = begin; s < slot; s += L) shade_pack(s, slot);
    if (g.colors != nullptr) copy_colors(begin, slot);
    if (slots.channels != nullptr) fill_channels(begin, slot);
    for (int64_t s = begin; s < slot; ++s)
      if (!has_finite_colors(s)) {
        drop(s);
        ++*invalid;
      }
  }

  int64_t project_pack(int64_t first, int64_t end, int64_t slot, int64_t* invalid) const {
    const auto& g = this->g;
    const auto& view = this->view;
    const auto& settings = this->settings;
    const auto c = [](double value) { return constant<V>(value); };
    alignas(64) int32_t rows[L];
    lane_rows<V>(first, end, rows);
    Projection<V> p;
    V opacity, finite;
    const auto alive = this->run(rows, p, opacity, finite);
    const V radius = bounding_radius(p);
    const V strength = opacity * p.rho;
    const V level = log_2(maximum(strength, c(1e-30)));
    const V cutoff = (level - c(kLog2AlphaMin)) * c(kCutoffScale) + c(kCutoffShift);
    const V two_ln2_cutoff = maximum(cutoff, c(0)) * c(2 * kLn2);
    const V lean_x = -p.kb / p.ka, lean_y = -p.kb / p.kc;

    alignas(64) S fields[kRecord][L], radius_of[L];
    store(fields[kU], p.u);
    store(fields[kV], p.v);
    store(fields[kA], c(-0.5 * kLog2e) * p.ka);
    store(fields[kB], c(-kLog2e) * p.kb);
    store(fields[kC], c(-0.5 * kLog2e) * p.kc);
    store(fields[kLevel], level);
    for (int k = kRed; k <= kBlue; ++k) store(fields[k], c(0));
    store(fields[kDepth], p.t[2]);
    store(fields[kLeanX], lean_x);
    store(fields[kLeanY], lean_y);
    store(fields[kHalfX], square_root(two_ln2_cutoff * p.c00));
    store(fields[kHalfY], square_root(two_ln2_cutoff * p.c11));
    store(fields[kWidth], square_root(two_ln2_cutoff / p.ka));
    store(fields[kCutoff], cutoff);
    store(radius_of, radius);

    const int lanes = int(end - first < L ? end - first : L);
    for (int i = 0; i < lanes; ++i) {
      const int64_t n = first + i;
      radii[n] = 0;
      if (g.visible != nullptr && !g.visible[n]) continue;
      if (lane(finite, i) != S(0)) ++*invalid;
      if (!lane(alive, i)) continue;
      const TileRange square =
          classic_tiles(fields[kU][i], fields[kV][i], radius_of[i], view.tiles_x(), view.tiles_y());
      if (square.count() == 0) continue;
      radii[n] = to_int(radius_of[i], 0, 1 << 30);
      if (!(fields[kCutoff][i] > S(kCutoffShift))) continue;  // nowhere above 1/255
      int tiles = square.count();
      if (settings.tight) {
        const Ellipse<S> e{fields[kU][i],
                           fields[kV][i],
                           fields[kHalfX][i],
                           fields[kHalfY][i],
                           fields[kWidth][i],
                           fields[kLeanX][i],
                           fields[kLeanY][i] * fields[kHalfX][i]};
        tiles = tight_tiles(e, view.width, view.height, [](int, int) {});
        if (tiles == 0) continue;
      }
      S* record = slots.records + slot * kRecord;
      for (int k = 0; k < kRecord; ++k) record[k] = fields[k][i];
      slots.index[slot] = int32_t(n);
      slots.run[slot] = {0, tiles};
      ++slot;
    }
    return slot;
  }

  void shade_pack(int64_t first, int64_t end) const {
    const auto& g = this->g;
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
      prefetch_sh_rest(first + L, end, basis_count);
      V rest[3 * kMaxBasis];
      gather_sh_rest(degree, rows, rest);
      const V* sh = rest - 3;  // sh[3 k + channel]
      V direction[3], basis[kMaxBasis];
      gather_rows<V, 3>(g.means, 3, rows, direction);
      for (int j = 0; j < 3; ++j) direction[j] -= this->view.center[j];
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
        const bool below = this->settings.clamp_color && out[k][i] < S(0);
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

  // The next pack's coefficients: rows of culled Gaussians in between keep the hardware from seeing a stream.
  SW_HD void prefetch_sh_rest(int64_t first, int64_t end, int basis_count) const {
    const auto& g = this->g;
    constexpr int kLine = 64 / sizeof(S);
    for (int64_t slot = first; slot < first + L && slot < end; ++slot) {
      const S* row = g.sh_rest + slots.index[slot] * g.sh_rest_stride;
      for (int k = 0; k < 3 * (basis_count - 1); k += kLine) __builtin_prefetch(row + k);
    }
  }

  // Constant row lengths: the tails become plain stores.
  SW_HD void gather_sh_rest(int degree, const int32_t* rows, V* rest) const {
    const auto& g = this->g;
    if (degree == 1) gather_long_rows<V>(g.sh_rest, g.sh_rest_stride, rows, 9, rest);
    if (degree == 2) gather_long_rows<V>(g.sh_rest, g.sh_rest_stride, rows, 24, rest);
    if (degree == 3) gather_long_rows<V>(g.sh_rest, g.sh_rest_stride, rows, 45, rest);
  }

  bool has_finite_colors(int64_t slot) const {
    const S* record = slots.records + slot * kRecord;
    S probe = finite_probe(record[kRed]) + finite_probe(record[kGreen]) + finite_probe(record[kBlue]);
    if (slots.channels != nullptr)
      for (int k = 0; k < channels.total(); ++k) probe += finite_probe(slots.channels[slot * channels.total() + k]);
    if (slots.color_slope != nullptr)
      for (int k = 0; k < 9; ++k) probe += finite_probe(slots.color_slope[slot * 9 + k]);
    return probe == S(0);
  }

  // Turns a slot into one that touches no tile and passes no gradient on.
  void drop(int64_t slot) const {
    radii[slots.index[slot]] = 0;
    slots.run[slot].count = 0;
    slots.clamped[slot] = 7;
    if (slots.color_slope != nullptr) std::fill_n(slots.color_slope + slot * 9, 9, S(0));
  }

  void copy_colors(int64_t begin, int64_t end) const {
    const auto& g = this->g;
    for (int64_t s = begin; s < end; ++s) {
      slots.clamped[s] = 0;
      if (g.color_channels != 3) continue;
      for (int k = 0; k < 3; ++k) slots.records[s * kRecord + kRed + k] = g.colors[slots.index[s] * int64_t(3) + k];
    }
  }

  void fill_channels(int64_t begin, int64_t end) const {
    const auto& g = this->g;
    for (int64_t s = begin; s < end; ++s) {
      const int64_t n = slots.index[s];
      const S* record = slots.records + s * kRecord;
      S* to = slots.channels + s * channels.total();
      for (int k = 0; k < channels.colors; ++k)
        *to++ = g.colors != nullptr ? g.colors[n * channels.colors + k] : record[kRed + k];
      if (channels.inverse) *to++ = S(1) / record[kDepth];
      if (channels.accumulated) *to++ = record[kDepth];
      for (int k = 0; k < channels.features; ++k) *to++ = g.features[n * channels.features + k];
    }
  }
};

template <class V, bool kCov3d>
int64_t project_all(const View<Scalar<V>>& view, const Gaussians<Scalar<V>>& g, const Settings& settings,
                    const Channels& channels, const Slots<Scalar<V>>& slots, int32_t* radii, int64_t* counts) {
  const int64_t chunks = (g.count + kChunk - 1) / kChunk;
  const ChunkProjection<V, kCov3d> project_chunk{{view, g, settings}, channels, slots, radii};
  std::atomic<int64_t> visible{0}, invalid{0};
  parallel_dynamic(settings.threads, chunks, [&](int64_t chunk) {
    int64_t bad = 0;
    project_chunk(chunk, &bad);
    const int32_t* first = radii + chunk * kChunk;
    visible += std::count_if(first, first + std::min<int64_t>(kChunk, g.count - chunk * kChunk),
                             [](int32_t radius) { return radius > 0; });
    invalid += bad;
  });
  counts[0] = visible, counts[1] = invalid;
  int64_t used = 0;
  for (int64_t chunk = 0; chunk < chunks; ++chunk) used += slots.per_chunk[chunk];
  return used;
}

template <class V, bool kCov3d>
void radii_of_all(const View<Scalar<V>>& view, const Gaussians<Scalar<V>>& g, const Settings& settings,
                  int32_t* radii) {
  using S = Scalar<V>;
  constexpr int L = lanes_of<V>;
  const Projector<V, kCov3d> projector{view, g, settings};
  const int64_t chunks = (g.count + kChunk - 1) / kChunk;
  parallel_dynamic(settings.threads, chunks, [&](int64_t chunk) {
    const int64_t begin = chunk * kChunk, end = begin + kChunk < g.count ? begin + kChunk : g.count;
    for (int64_t first = begin; first < end; first += L) {
      alignas(64) int32_t rows[L];
      lane_rows<V>(first, end, rows);
      Projection<V> p;
      V opacity, finite;
      const auto alive = projector.run(rows, p, opacity, finite);
      const V radius = bounding_radius(p);
      for (int i = 0; i < L && first + i < end; ++i) {
        const bool drawn = lane(alive, i) && (g.visible == nullptr || g.visible[first + i]);
        const S r = lane(radius, i);
        const bool inside =
            drawn && classic_tiles(lane(p.u, i), lane(p.v, i), r, view.tiles_x(), view.tiles_y()).count() > 0;
        radii[first + i] = inside ? to_int(r, 0, 1 << 30) : 0;
      }
    }
  });
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                       \
  template <>                                                                                                      \
  int64_t project_gaussians<S>(const View<S>& view, const Gaussians<S>& g, const Settings& settings,               \
                               const Channels& channels, const Slots<S>& slots, int32_t* radii, int64_t* counts) { \
    return g.cov3d != nullptr ? project_all<V, true>(view, g, settings, channels, slots, radii, counts)            \
                              : project_all<V, false>(view, g, settings, channels, slots, radii, counts);          \
  }                                                                                                                \
  template <>                                                                                                      \
  void visible_radii<S>(const View<S>& view, const Gaussians<S>& g, const Settings& settings, int32_t* radii) {    \
    g.cov3d != nullptr ? radii_of_all<V, true>(view, g, settings, radii)                                           \
                       : radii_of_all<V, false>(view, g, settings, radii);                                         \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
