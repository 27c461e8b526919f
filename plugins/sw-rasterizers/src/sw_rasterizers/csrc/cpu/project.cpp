// Projection: culls, projects and colours the Gaussians, a pack of them at a time.
//
// A thread takes kChunk Gaussians. What is drawn gets a slot; the slots of a chunk are compact and start at the chunk's
// first index, so that slots ascend with the Gaussian index without a second pass. Colours are evaluated for
// slots only: their coefficients, three quarters of all input bytes, are not even read for the culled ones.
#include <algorithm>

#include "../projection.h"
#include "gather.h"
#include "kernels.h"
#include "parallel.h"
#include "shade.h"
#include "shape.h"
#include "tile_list.h"

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
      gather_shape<V>(g, rows, in);
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

template <class V, bool kCov3d>
struct ChunkProjection : Projector<V, kCov3d> {
  using S = Scalar<V>;
  using Base = Projector<V, kCov3d>;
  static constexpr int L = lanes_of<V>;
  const Channels& channels;
  const Slots<S>& slots;
  int32_t* radii;

  void operator()(int64_t chunk, TileList& tile_list, int64_t* invalid) const {
    const auto& g = this->g;
    const int64_t begin = chunk * kChunk, end = begin + kChunk < g.count ? begin + kChunk : g.count;
    int64_t slot = begin;
    for (int64_t first = begin; first < end; first += L) slot = project_pack(first, end, slot, tile_list, invalid);
    const int64_t used = slot - begin;
    slots.per_chunk[chunk] = int32_t(used);
    const Shader<V> shader{this->view, g, this->settings, slots};
    shader.color(begin, slot);
    if (slots.channels != nullptr) fill_channels(begin, slot);
    const int total = slots.channels != nullptr ? channels.total() : 0;
    *invalid += shader.drop_broken(begin, slot, total, radii);
  }

  int64_t project_pack(int64_t first, int64_t end, int64_t slot, TileList& tile_list, int64_t* invalid) const {
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

    V fields[kRecord];
    fields[kU] = p.u, fields[kV] = p.v;
    fields[kA] = c(-0.5 * kLog2e) * p.ka, fields[kB] = c(-kLog2e) * p.kb, fields[kC] = c(-0.5 * kLog2e) * p.kc;
    fields[kLevel] = level;
    fields[kRed] = fields[kGreen] = fields[kBlue] = c(0);
    fields[kDepth] = p.t[2];
    fields[kLeanX] = -p.kb / p.ka, fields[kLeanY] = -p.kb / p.kc;
    fields[kHalfX] = square_root(two_ln2_cutoff * p.c00), fields[kHalfY] = square_root(two_ln2_cutoff * p.c11);
    fields[kWidth] = square_root(two_ln2_cutoff / p.ka);
    fields[kCutoff] = cutoff;
    alignas(64) S records[L][kRecord];
    for (int f = 0; f < kRecord; f += L) {
      transpose(fields + f);
      for (int i = 0; i < L; ++i) store(records[i] + f, fields[f + i]);
    }

    // Seen by 3DGS: the square of the bounding radius meets a tile.
    const V edge = c(1.0 / kTile), half = c(0.5), zero = c(0);
    const auto meets = [&](V centre, int tiles) {
      const V low = (centre - half - radius) * edge, high = (centre - half + radius + c(kTile - 1)) * edge;
      return minimum(round_down(maximum(high, zero)), c(tiles)) > minimum(round_down(maximum(low, zero)), c(tiles));
    };
    const auto seen = alive & meets(p.u, view.tiles_x()) & meets(p.v, view.tiles_y());
    alignas(64) int32_t radius_of[L];
    store(radius_of, to_integer(select(seen, minimum(radius, c(1 << 30)), zero)));

    const int lanes = int(end - first < L ? end - first : L);
    for (int i = 0; i < lanes; ++i) {
      const int64_t n = first + i;
      const bool asked = g.visible == nullptr || g.visible[n];
      radii[n] = asked ? radius_of[i] : 0;
      if (asked && lane(finite, i) != S(0)) ++*invalid;
      const S* record = records[i];
      // The second is false where alpha is nowhere above 1/255.
      if (radii[n] == 0 || !(record[kCutoff] > S(kCutoffShift))) continue;
      const size_t listed = tile_list.size();
      const int tiles = list_tiles(view, settings, record, record[kU], record[kV], S(radii[n]), tile_list,
                                   [](int, int) { return true; });
      if (tiles == 0) continue;
      tile_list.listed += tiles;
      std::copy_n(record, int(kRecord), slots.records + slot * kRecord);
      slots.index[slot] = int32_t(n);
      prefetch_sh_rest(g, n);
      slots.run[slot] = {int32_t(listed), tiles};
      ++slot;
    }
    return slot;
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
  const ChunkProjection<V, kCov3d> project_chunk{{view, g, settings}, channels, slots, radii};
  return project_chunks(settings.parallel, g.count, slots, radii, counts, project_chunk);
}

template <class V, bool kCov3d>
void radii_of_all(const View<Scalar<V>>& view, const Gaussians<Scalar<V>>& g, const Settings& settings,
                  int32_t* radii) {
  using S = Scalar<V>;
  constexpr int L = lanes_of<V>;
  const Projector<V, kCov3d> projector{view, g, settings};
  const int64_t chunks = (g.count + kChunk - 1) / kChunk;
  parallel_dynamic(settings.parallel, chunks, [&](int64_t chunk) {
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
