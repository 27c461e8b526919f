// Backward compositing of surfels: the scheme of blend_backward.cpp, one row of sums per (splat, tile) pair.
//
// With zeta = 1/z, delta = zeta - zeta of the pixel's first surfel, and the totals A, J1, J2 of weight x (1, delta,
// delta^2), everything that the maps add to phi and to dL/dzeta is, per pixel,
//     phi   += a0 + delta (a1 + delta a2) + z gD + n . gN       a0 = gdist J2 + gI zeta0, a1 = gI - 2 gdist J1,
//     dzeta  = weight (a1 + 2 delta a2) - z^2 (weight gD + [median] gM)                      a2 = gdist A
// and dL/dw += dzeta / tz. (gdist carries the square of the slope of m over zeta.)
#include <limits>
#include <memory>

#include "parallel.h"
#include "surfel_kernels.h"
#include "tile_stage.h"

namespace SW_ARCH {
namespace {

template <class V, bool kWithMaps>
struct SurfelBackward {
  using S = Scalar<V>;
  using I = IntOf<V>;
  static constexpr int L = lanes_of<V>;
  static constexpr int kPacks = kBlockPixels / L;
  static constexpr int kPixels = kTilePixels + kBlockPixels;  // with the spare block
  static constexpr int kColumns = kWithMaps ? int(kSurfelColumns) : int(kSurfelPlain);
  static constexpr int kAhead = 8;  // pairs between prefetch and use of a plane

  const View<S>& view;
  const Settings& settings;
  const Slots<S>& slots;
  const S* planes;
  const Pairs<S>& pairs;
  const SurfelCanvas<S>& target;
  const CanvasGradient<S>& gradient;
  const S* maps_gradient;
  S* sums;
  S inverse_far;

  // Gradients per pixel, and what the maps make of them.
  // clang-format off
  enum Field {
    kRedOf, kGreenOf, kBlueOf, kDepthOf, kNormalX, kNormalY, kNormalZ, kMedianOf, kFirst, kA0, kA1, kA2, kFields
  };
  // clang-format on

  struct Workspace {
    PixelCentres<S, kPixels> centres;
    alignas(64) S transmittance[kPixels];
    alignas(64) S behind[kPixels];
    alignas(64) S field[kWithMaps ? int(kFields) : 3][kPixels];
    alignas(64) int32_t last[kPixels];
    alignas(64) int32_t median[kPixels];
    V clamp_limit;  // of the unclamped alpha, above which its gradient is 0
  };

  void operator()(int64_t tile, Workspace& w) const {
    const TileFrame frame(view, tile);
    const int64_t begin = pairs.tile_start[tile], end = pairs.tile_start[tile + 1];
    if (begin == end) return;
    load_pixels(tile, frame, w);
    const int64_t used = *std::max_element(w.last, w.last + kTilePixels);
    // Splats that no pixel reached have no row of their own to fill but must not leave garbage.
    for (int64_t i = begin + used; i < end; ++i) std::fill_n(row(i), kColumns, S(0));
    for (int64_t i = begin + used; i-- > begin;) {
      if (i >= begin + kAhead) {
        __builtin_prefetch(slots.records + int64_t(pairs.slot[i - kAhead]) * kRecord);
        __builtin_prefetch(planes + int64_t(pairs.slot[i - kAhead]) * kPlane);
      }
      blend_splat(w, i, int32_t(i - begin));
    }
  }

  S* row(int64_t pair) const { return sums + int64_t(pairs.origin[pair]) * kColumns; }

  void load_pixels(int64_t tile, const TileFrame& frame, Workspace& w) const {
    const Canvas<S>& canvas = target.canvas;
    const int64_t size = int64_t(view.width) * view.height, offset = tile * kTilePixels;
    w.centres.set(frame);
    w.clamp_limit = constant<V>(settings.pass_clamp ? double(std::numeric_limits<float>::max()) : kAlphaMax);
    std::fill_n(w.transmittance, kPixels, S(1));
    std::fill_n(w.last, kPixels, 0);
    std::fill_n(w.median, kPixels, 0);
    std::fill_n(w.behind, kPixels, S(0));
    std::copy_n(canvas.transmittance + offset, kTilePixels, w.transmittance);
    std::copy_n(canvas.last + offset, kTilePixels, w.last);
    for (auto& field : w.field) std::fill_n(field, kPixels, S(0));
    if constexpr (kWithMaps) std::copy_n(target.pixels.median + offset, kTilePixels, w.median);
    frame.for_each_pixel([&](int i, int x, int y) {
      const int64_t pixel = int64_t(frame.y0 + y) * view.width + frame.x0 + x;
      S behind = gradient.alpha != nullptr ? -gradient.alpha[pixel] : S(0);
      for (int channel = 0; channel < 3; ++channel) {
        const S g = gradient.image[channel * size + pixel];
        w.field[channel][i] = g;
        if (canvas.background != nullptr)
          behind += g * canvas.background[canvas.background_is_image ? channel * size + pixel : int64_t(channel)];
      }
      w.behind[i] = w.transmittance[i] * behind;
      if constexpr (kWithMaps) {
        const auto g = [&](int map) { return maps_gradient[map * size + pixel]; };
        w.field[kDepthOf][i] = g(kMapDepth);
        for (int k = 0; k < 3; ++k) w.field[kNormalX + k][i] = g(kMapNormal + k);
        w.field[kMedianOf][i] = g(kMapMedian);
        const S first = target.pixels.first[offset + i], distortion = S(kDistortionScale) * g(kMapDistortion);
        w.field[kFirst][i] = first;
        w.field[kA0][i] = distortion * target.pixels.square[offset + i] + g(kMapInverse) * first;
        w.field[kA1][i] = g(kMapInverse) - S(2) * distortion * target.pixels.sum[offset + i];
        w.field[kA2][i] = distortion * (S(1) - w.transmittance[i]);
      }
    });
  }

  void blend_splat(Workspace& w, int64_t pair, int32_t position) const {
    const int64_t slot = pairs.slot[pair];
    const S* record = slots.records + slot * kRecord;
    const S* plane = planes + slot * kPlane;
    V sum[kSurfelColumns] = {};
    // Two blocks a turn, as for ellipsoids; the second may be the spare block behind the tile.
    unsigned mask = pairs.blocks[pair];
    while (mask != 0) {
      const int first = __builtin_ctz(mask);
      mask &= mask - 1;
      const int second = mask != 0 ? __builtin_ctz(mask) : kBlocks;
      mask &= mask - 1;  // 0 stays 0
      for (int pack = 0; pack < kPacks; ++pack) {
        blend_pack(w, first * kBlockPixels + pack * L, position, record, plane, sum);
        blend_pack(w, second * kBlockPixels + pack * L, position, record, plane, sum);
      }
    }
    lane_sums<V, kColumns>(sum, row(pair));
  }

  SW_HD void blend_pack(Workspace& w, int at, int32_t position, const S* record, const S* plane, V* sum) const {
    const V zero = constant<V>(0), two = constant<V>(2);
    const V x = load<V>(w.centres.x + at), y = load<V>(w.centres.y + at);
    const auto hit = hit_surfel<V>(plane, record[kLevel], inverse_far, x, y);
    const auto touched =
        hit.met & (hit.power >= constant<V>(kLog2AlphaMin)) & (load<I>(w.last + at) > position);
    const V unclamped = select(touched, exp_2(hit.power), zero);
    const V alpha = minimum(constant<V>(kAlphaMax), unclamped);
    const auto g = [&](int field) { return load<V>(w.field[field] + at); };

    V phi = record[kRed] * g(kRedOf) + record[kGreen] * g(kGreenOf) + record[kBlue] * g(kBlueOf);
    V z = zero, zeta = zero, delta = zero;
    if constexpr (kWithMaps) {
      z = plane[kPlaneZ] * hit.inverse_w, zeta = plane[kPlaneInverseZ] * hit.w, delta = zeta - g(kFirst);
      phi += g(kA0) + delta * (g(kA1) + delta * g(kA2)) + z * g(kDepthOf) + plane[kPlaneNormal] * g(kNormalX) +
             plane[kPlaneNormal + 1] * g(kNormalY) + plane[kPlaneNormal + 2] * g(kNormalZ);
    }
    V transmittance = load<V>(w.transmittance + at), behind = load<V>(w.behind + at), weight;
    const V alpha_gradient = composite_backward(alpha, phi, transmittance, behind, weight);
    store(w.transmittance + at, transmittance);
    store(w.behind + at, behind);

    // The clamp at 0.99 stops the gradient, unless it is asked to pass: then the unclamped alpha stands in front.
    const V through = select(unclamped <= w.clamp_limit, unclamped, zero);
    const V strength = through * alpha_gradient;  // -2 dL/drho
    const V on_plane = select(hit.on_plane, strength, zero), low = strength - on_plane;
    const V slope = -(on_plane * hit.inverse_w * hit.inverse_w);
    const V g1 = slope * hit.n1, g2 = slope * hit.n2;
    V gw = -((g1 * hit.n1 + g2 * hit.n2) * hit.inverse_w);
    if constexpr (kWithMaps) {
      const auto is_median = touched & (load<I>(w.median + at) == position + 1);
      const V to_depth = weight * g(kDepthOf) + select(is_median, g(kMedianOf), zero);
      const V to_zeta = select(touched, weight * (g(kA1) + two * delta * g(kA2)) - z * z * to_depth, zero);
      gw += plane[kPlaneInverseZ] * to_zeta;
      sum[kSumZeta] += zeta * to_zeta;
      for (int k = 0; k < 3; ++k) sum[kSumNormal + k] += weight * g(kNormalX + k);
    }
    const V dx = x - plane[kPlaneU], dy = y - plane[kPlaneV];
    const V gradients[3] = {g1, g2, gw};
    for (int i = 0; i < 3; ++i) {
      sum[3 * i] += gradients[i];
      sum[3 * i + 1] += gradients[i] * dx;
      sum[3 * i + 2] += gradients[i] * dy;
    }
    // dL/drho dlow^2/dcentre / 4 = (-strength / 2) (-low).
    sum[kSumLowX] += constant<V>(0.5) * low * hit.low_x;
    sum[kSumLowY] += constant<V>(0.5) * low * hit.low_y;
    sum[kSumAlpha] += strength;
    for (int channel = 0; channel < 3; ++channel) sum[kSumRed + channel] += weight * g(channel);
  }
};

template <class V, bool kWithMaps>
void backward_tiles(const View<Scalar<V>>& view, const Settings& settings, const Slots<Scalar<V>>& slots,
                    const Scalar<V>* planes, const Pairs<Scalar<V>>& pairs, const SurfelCanvas<Scalar<V>>& target,
                    const CanvasGradient<Scalar<V>>& gradient, const Scalar<V>* maps_gradient, Scalar<V>* sums) {
  using Backward = SurfelBackward<V, kWithMaps>;
  const Backward backward{view,   settings, slots,         planes, pairs,
                          target, gradient, maps_gradient, sums,   Scalar<V>(1) / view.far};
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const std::vector<int32_t> order = tiles_by_work(pairs.tile_start, tiles);
  std::atomic<int64_t> next{0};
  parallel(settings.parallel, [&] {
    const auto w = std::make_unique<typename Backward::Workspace>();
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tiles;) backward(order[size_t(i)], *w);
  });
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                          \
  template <>                                                                                                         \
  void blend_surfels_backward<S>(const View<S>& view, const Settings& settings, const Slots<S>& slots,                \
                                 const S* planes, const Pairs<S>& pairs, const SurfelCanvas<S>& canvas,               \
                                 const CanvasGradient<S>& gradient, const S* maps_gradient, S* sums) {                \
    const auto run = maps_gradient != nullptr ? backward_tiles<V, true> : backward_tiles<V, false>;                   \
    run(view, settings, slots, planes, pairs, canvas, gradient, maps_gradient, sums);                                 \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
