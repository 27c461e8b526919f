// Projection of surfels: as project.cpp, with a plane instead of a conic.
#include <algorithm>
#include <atomic>

#include "gather.h"
#include "parallel.h"
#include "shade.h"
#include "surfel_kernels.h"
#include "tile_list.h"

namespace SW_ARCH {
namespace {

// The pixel test alone decides what is drawn; boxes and tiles are chosen on a slightly larger ellipse.
constexpr double kCutoffScale = 1.001, kCutoffShift = 1e-3;

template <class V>
struct SurfelProjector {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const View<S>& view;
  const Gaussians<S>& g;
  const Settings& settings;

  // Projects rows[0..L); returns the mask of those that a camera in front of them can see.
  auto run(const int32_t* rows, SurfelProjection<V>& p, V& opacity, V& finite) const {
    const V zero = constant<V>(0);
    SurfelGeometry<V> in;
    gather_rows<V, 3>(g.means, 3, rows, in.mean);
    gather_rows<V, 2>(g.scales, 2, rows, in.scale);
    gather_rows<V, 4>(g.quats, 4, rows, in.quat);
    opacity = constant<V>(1);
    if (g.opacities != nullptr) gather_rows<V, 1>(g.opacities, 1, rows, &opacity);
    finite = finite_probe(opacity);
    for (const V& x : in.mean) finite += finite_probe(x);
    for (const V& x : in.scale) finite += finite_probe(x);
    for (const V& x : in.quat) finite += finite_probe(x);
    project_surfel(view, S(settings.scale_modifier), in, p);
    V derived = finite_probe(p.u0) + finite_probe(p.v0) + finite_probe(p.center_x) + finite_probe(p.center_y) +
                finite_probe(p.extent_x) + finite_probe(p.extent_y);
    // No ray meets an edge-on plane, or one with a scale of zero: its coefficients are infinite. With room for the
    // pixels they are multiplied by.
    for (const V* x : {&p.a, &p.b, &p.c, &p.d, &p.e, &p.f}) derived += finite_probe(*x * constant<V>(1e6));
    return (finite == zero) & (derived == zero) & (p.t[2] > constant<V>(view.near)) &
           (p.t[2] < constant<V>(view.far)) & (p.denominator != zero) & (p.facing != zero) & (opacity >= zero);
  }

  // Seen by 2DGS: the square of the bounding radius around the centre of the extent meets a tile.
  auto meets_tiles(const SurfelProjection<V>& p, V radius) const {
    const auto c = [](double value) { return constant<V>(value); };
    const V edge = c(1.0 / kTile), half = c(0.5), zero = c(0);
    const auto meets = [&](V centre, int tiles) {
      const V low = (centre - half - radius) * edge, high = (centre - half + radius + c(kTile - 1)) * edge;
      return minimum(round_down(maximum(high, zero)), c(tiles)) > minimum(round_down(maximum(low, zero)), c(tiles));
    };
    return meets(p.u0 + p.center_x, view.tiles_x()) & meets(p.v0 + p.center_y, view.tiles_y());
  }

  // Radii of the pack: 0 where not seen.
  V radii(const int32_t* rows, SurfelProjection<V>& p, V& opacity, V& finite) const {
    const auto alive = run(rows, p, opacity, finite);
    const V radius = surfel_radius(p);
    return select(alive & meets_tiles(p, radius), minimum(radius, constant<V>(1 << 30)), constant<V>(0));
  }
};

template <class V>
struct ChunkProjection : SurfelProjector<V> {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  const Slots<S>& slots;
  S* planes;
  int32_t* radii_of_all;

  void operator()(int64_t chunk, TileList& tile_list, int64_t* invalid) const {
    const auto& g = this->g;
    const int64_t begin = chunk * kChunk, end = std::min(begin + kChunk, g.count);
    int64_t slot = begin;
    for (int64_t first = begin; first < end; first += L) slot = project_pack(first, end, slot, tile_list, invalid);
    slots.per_chunk[chunk] = int32_t(slot - begin);
    const Shader<V> shader{this->view, g, this->settings, slots};
    shader.color(begin, slot);
    *invalid += shader.drop_broken(begin, slot, 0, radii_of_all);
  }

  int64_t project_pack(int64_t first, int64_t end, int64_t slot, TileList& tile_list, int64_t* invalid) const {
    const auto& g = this->g;
    const auto& view = this->view;
    const auto c = [](double value) { return constant<V>(value); };
    alignas(64) int32_t rows[L];
    lane_rows<V>(first, end, rows);
    SurfelProjection<V> p;
    V opacity, finite;
    const V radius = this->radii(rows, p, opacity, finite);
    const V level = log_2(maximum(opacity, c(1e-30)));
    const V cutoff = (level - c(kLog2AlphaMin)) * c(kCutoffScale) + c(kCutoffShift);
    const V reach = maximum(cutoff, c(kCutoffShift)) * c(2 * kLn2);
    const SurfelBound<V> bound = surfel_bound(view, p, reach);

    V fields[kRecord];
    fields[kU] = bound.u, fields[kV] = bound.v;
    fields[kA] = c(-0.5 * kLog2e) * bound.ka, fields[kB] = c(-kLog2e) * bound.kb;
    fields[kC] = c(-0.5 * kLog2e) * bound.kc;
    fields[kLevel] = level;
    fields[kRed] = fields[kGreen] = fields[kBlue] = c(0);
    fields[kDepth] = p.t[2];
    fields[kLeanX] = -bound.kb / bound.ka, fields[kLeanY] = -bound.kb / bound.kc;
    fields[kHalfX] = square_root(reach * bound.c00), fields[kHalfY] = square_root(reach * bound.c11);
    fields[kWidth] = square_root(reach / bound.ka);
    fields[kCutoff] = cutoff;
    V plane[kPlane];
    plane[kPlaneA] = p.a, plane[kPlaneB] = p.b, plane[kPlaneC] = p.c, plane[kPlaneD] = p.d;
    plane[kPlaneE] = p.e, plane[kPlaneF] = p.f;
    plane[kPlaneU] = p.u0, plane[kPlaneV] = p.v0;
    plane[kPlaneCenterX] = p.center_x, plane[kPlaneCenterY] = p.center_y;
    plane[kPlaneZ] = p.t[2], plane[kPlaneInverseZ] = c(1) / p.t[2];
    for (int i = 0; i < 3; ++i) plane[kPlaneNormal + i] = p.sign * p.axes[3 * i + 2];
    plane[kPlaneFarthest] = p.t[2] * c(1.0 / view.near);
    alignas(64) S records[L][kRecord], plane_of[L][kPlane];
    static_assert(kRecord == kPlane);
    for (int f = 0; f < kRecord; f += L) {
      transpose(fields + f);
      transpose(plane + f);
      for (int i = 0; i < L; ++i) store(records[i] + f, fields[f + i]);
      for (int i = 0; i < L; ++i) store(plane_of[i] + f, plane[f + i]);
    }
    alignas(64) int32_t radius_of[L];
    store(radius_of, to_integer(radius));
    alignas(64) S center[2][L];
    store(center[0], p.u0 + p.center_x), store(center[1], p.v0 + p.center_y);

    const int lanes = int(std::min<int64_t>(end - first, L));
    for (int i = 0; i < lanes; ++i) {
      const int64_t n = first + i;
      const bool asked = g.visible == nullptr || g.visible[n];
      radii_of_all[n] = asked ? radius_of[i] : 0;
      if (asked && lane(finite, i) != S(0)) ++*invalid;
      const S* record = records[i];
      // The second is false where alpha is nowhere above 1/255.
      if (radii_of_all[n] == 0 || !(record[kCutoff] > S(kCutoffShift))) continue;
      const size_t listed = tile_list.size();
      const LargeSurfel<S> large(record, plane_of[i]);
      const auto accept = [&](int x, int y) {
        return !large.is_large || large.meets(S(kTile * (x + 0.5)), S(kTile * (y + 0.5)), S(kTile * 0.5));
      };
      const int tiles =
          list_tiles(view, this->settings, record, center[0][i], center[1][i], S(radii_of_all[n]), tile_list, accept);
      if (tiles == 0) continue;
      tile_list.listed += tiles;
      std::copy_n(record, int(kRecord), slots.records + slot * kRecord);
      std::copy_n(plane_of[i], int(kPlane), planes + slot * kPlane);
      slots.index[slot] = int32_t(n);
      prefetch_sh_rest(g, n);
      slots.run[slot] = {int32_t(listed), tiles};
      ++slot;
    }
    return slot;
  }
};

template <class V>
int64_t project_all(const View<Scalar<V>>& view, const Gaussians<Scalar<V>>& g, const Settings& settings,
                    const Slots<Scalar<V>>& slots, Scalar<V>* planes, int32_t* radii, int64_t* counts) {
  const ChunkProjection<V> project_chunk{{view, g, settings}, slots, planes, radii};
  return project_chunks(settings.parallel, g.count, slots, radii, counts, project_chunk);
}

template <class V>
void radii_of(const View<Scalar<V>>& view, const Gaussians<Scalar<V>>& g, const Settings& settings, int32_t* radii) {
  constexpr int L = lanes_of<V>;
  const SurfelProjector<V> projector{view, g, settings};
  parallel_dynamic(settings.parallel, (g.count + kChunk - 1) / kChunk, [&](int64_t chunk) {
    const int64_t begin = chunk * kChunk, end = std::min(begin + kChunk, g.count);
    for (int64_t first = begin; first < end; first += L) {
      alignas(64) int32_t rows[L];
      lane_rows<V>(first, end, rows);
      SurfelProjection<V> p;
      V opacity, finite;
      alignas(64) int32_t found[L];
      store(found, to_integer(projector.radii(rows, p, opacity, finite)));
      for (int i = 0; i < L && first + i < end; ++i)
        radii[first + i] = g.visible == nullptr || g.visible[first + i] ? found[i] : 0;
    }
  });
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                       \
  template <>                                                                                                      \
  int64_t project_surfels<S>(const View<S>& view, const Gaussians<S>& g, const Settings& settings,                 \
                             const Slots<S>& slots, S* planes, int32_t* radii, int64_t* counts) {                  \
    return project_all<V>(view, g, settings, slots, planes, radii, counts);                                        \
  }                                                                                                                \
  template <>                                                                                                      \
  void visible_surfel_radii<S>(const View<S>& view, const Gaussians<S>& g, const Settings& settings,               \
                               int32_t* radii) {                                                                   \
    radii_of<V>(view, g, settings, radii);                                                                         \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
