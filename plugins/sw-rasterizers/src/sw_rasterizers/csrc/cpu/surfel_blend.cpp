// Forward compositing of surfels, one tile at a time: the scheme of blend.cpp, with the ray-plane intersection as the
// falloff and, if maps are asked for, depth, normals and distortion summed along in registers.
#include <memory>

#include "parallel.h"
#include "surfel_kernels.h"
#include "tile_stage.h"

namespace SW_ARCH {
namespace {

template <class V, bool kWithMaps>
struct SurfelBlender {
  using S = Scalar<V>;
  using I = IntOf<V>;
  static constexpr int L = lanes_of<V>;
  static constexpr int kPacks = kBlockPixels / L;

  const View<S>& view;
  const Slots<S>& slots;
  const S* planes;
  const Pairs<S>& pairs;
  const SurfelCanvas<S>& target;
  S inverse_far;

  // Per pixel, in block order. The sums of the maps are written and read once a stage and block.
  // clang-format off
  enum Field {
    kTransmittanceOf, kRedOf, kGreenOf, kBlueOf,
    kFirst, kSum, kSquare,  // see SurfelPixels
    kDepthOf, kNormalX, kNormalY, kNormalZ, kDistortionOf, kMedianOf, kFields
  };
  // clang-format on

  struct Workspace {
    TileStage<V> stage;
    PixelCentres<S> centres;
    uint8_t list[kBlocks][kStage];
    int length[kBlocks];
    alignas(64) S field[kFields][kTilePixels];
    alignas(64) int32_t last[kTilePixels];
    alignas(64) int32_t median[kTilePixels];  // list position of the surfel that crosses T = 1/2
    int64_t evaluated = 0, blended = 0;
  };

  void operator()(int64_t tile, Workspace& w) const {
    const TileFrame frame(view, tile);
    const int64_t begin = pairs.tile_start[tile], end = pairs.tile_start[tile + 1];
    w.centres.set(frame);
    for (auto& field : w.field) std::fill(field, field + kTilePixels, S(0));
    std::fill(w.last, w.last + kTilePixels, 0);
    std::fill(w.median, w.median + kTilePixels, 0);
    S* transmittance = w.field[kTransmittanceOf];
    std::fill(transmittance, transmittance + kTilePixels, S(-1));  // outside the image: done
    frame.for_each_pixel([&](int i, int, int) { transmittance[i] = S(1); });
    unsigned live = 0;
    for (int b = 0; b < kBlocks; ++b) live |= unsigned(is_live(w, b)) << b;

    for (int64_t first = begin; first < end && live != 0; first += kStage) {
      const int count = int(std::min<int64_t>(kStage, end - first));
      w.stage.load_splats(slots, pairs.slot + first, count, end - first);
      w.stage.find_blocks(frame, count);
      std::fill(w.length, w.length + kBlocks, 0);
      for (int k = 0; k < count; ++k) {
        unsigned mask = unsigned(w.stage.blocks[k]) & live;
        const auto& record = w.stage.field;
        const S* plane = planes + int64_t(pairs.slot[first + k]) * kPlane;
        const LargeSurfel<S> large(plane, record[kCutoff][k], record[kHalfX][k] + record[kHalfY][k]);
        if (mask != 0 && large.is_large) mask &= met_blocks(large, frame);
        if (pairs.blocks != nullptr) pairs.blocks[first + k] = mask;
        if (mask != 0) __builtin_prefetch(plane);
        for (; mask != 0; mask &= mask - 1) {
          const int b = __builtin_ctz(mask);
          w.list[b][w.length[b]++] = uint8_t(k);
        }
      }
      for (int b = 0; b < kBlocks; ++b) {
        if (w.length[b] == 0) continue;
        if (target.canvas.counters != nullptr) count_pairs(w, b, first);
        for (int pack = 0; pack < kPacks; ++pack) blend_pack(w, b, pack, first, int32_t(first - begin));
        if (!is_live(w, b)) live &= ~(1u << b);
      }
    }
    write(tile, frame, w, begin);
  }

  // Blocks of the tile that the plane (or the low-pass around its centre) may touch.
  static unsigned met_blocks(const LargeSurfel<S>& large, const TileFrame& frame) {
    unsigned mask = 0;
    for (int b = 0; b < kBlocks; b += L) {
      alignas(64) S x[L], y[L];
      for (int i = 0; i < L; ++i) {
        x[i] = S(frame.x0 + (b + i) % kBlocksPerRow * kBlockWidth + kBlockWidth / 2);
        y[i] = S(frame.y0 + (b + i) / kBlocksPerRow * kBlockHeight + kBlockHeight / 2);
      }
      const auto met = large.meets(load<V>(x), load<V>(y), S(kBlockWidth / 2));
      for (int i = 0; i < L; ++i) mask |= unsigned(lane(met, i)) << (b + i);
    }
    return mask;
  }

  static bool is_live(const Workspace& w, int block) {
    for (int i = 0; i < kBlockPixels; ++i)
      if (w.field[kTransmittanceOf][block * kBlockPixels + i] > S(0)) return true;
    return false;
  }

  void blend_pack(Workspace& w, int block, int pack, int64_t first, int32_t base) const {
    const int at = block * kBlockPixels + pack * L;
    const auto& record = w.stage.field;
    const V x = load<V>(w.centres.x + at), y = load<V>(w.centres.y + at);
    const V zero = constant<V>(0), one = constant<V>(1), ceiling = constant<V>(kAlphaMax);
    const V threshold = constant<V>(kLog2AlphaMin);
    constexpr int kUsed = kWithMaps ? int(kFields) : int(kBlueOf) + 1;
    V f[kUsed];
    for (int k = 0; k < kUsed; ++k) f[k] = load<V>(w.field[k] + at);
    I last = load<I>(w.last + at), median{};
    if constexpr (kWithMaps) median = load<I>(w.median + at);

    const uint8_t* list = w.list[block];
    for (int n = 0; n < w.length[block]; ++n) {
      const int k = list[n];
      const S* plane = planes + int64_t(pairs.slot[first + k]) * kPlane;
      const auto hit = hit_surfel<V>(plane, record[kLevel][k], inverse_far, x, y);
      const auto touched = hit.met & (hit.power >= threshold);
      const V alpha = select(touched, minimum(ceiling, exp_2(hit.power)), zero);
      const V before = f[kTransmittanceOf];
      const V weight = composite(alpha, f[kTransmittanceOf]);
      const auto drawn = weight > zero;
      const I position = I{} + (base + k + 1);
      last = select(drawn, position, last);
      f[kRedOf] += weight * record[kRed][k];
      f[kGreenOf] += weight * record[kGreen][k];
      f[kBlueOf] += weight * record[kBlue][k];
      if constexpr (kWithMaps) {
        const V z = plane[kPlaneZ] * hit.inverse_w, zeta = plane[kPlaneInverseZ] * hit.w;
        f[kFirst] = select(drawn & (before >= one), zeta, f[kFirst]);
        const V delta = zeta - f[kFirst];
        // weight (m^2 A + M2 - 2 m M1) = weight * scale * sum_j w_j (delta - delta_j)^2
        f[kDistortionOf] += weight * (f[kSquare] + delta * ((one - before) * delta - S(2) * f[kSum]));
        const V moment = weight * delta;
        f[kSum] += moment;
        f[kSquare] += moment * delta;
        f[kDepthOf] += weight * z;
        f[kNormalX] += weight * plane[kPlaneNormal];
        f[kNormalY] += weight * plane[kPlaneNormal + 1];
        f[kNormalZ] += weight * plane[kPlaneNormal + 2];
        const auto halfway = drawn & (before > constant<V>(0.5));
        f[kMedianOf] = select(halfway, z, f[kMedianOf]);
        median = select(halfway, position, median);
      }
      if ((n & 15) == 15 && !any(f[kTransmittanceOf] > zero)) break;
    }

    for (int k = 0; k < kUsed; ++k) store(w.field[k] + at, f[k]);
    store(w.last + at, last);
    if constexpr (kWithMaps) store(w.median + at, median);
  }

  // The counting mode: pixel-splat pairs whose exponent is evaluated, and those that are blended.
  void count_pairs(Workspace& w, int block, int64_t first) const {
    for (int i = block * kBlockPixels; i < (block + 1) * kBlockPixels; ++i) {
      S transmittance = w.field[kTransmittanceOf][i];
      for (int n = 0; n < w.length[block]; ++n) {
        const int k = w.list[block][n];
        const auto hit = hit_surfel<S>(planes + int64_t(pairs.slot[first + k]) * kPlane, w.stage.field[kLevel][k],
                                       inverse_far, w.centres.x[i], w.centres.y[i]);
        ++w.evaluated;
        if (!(hit.met && hit.power >= S(kLog2AlphaMin))) continue;
        w.blended += composite(minimum(S(kAlphaMax), exp_2(hit.power)), transmittance) > S(0);
      }
    }
  }

  void write(int64_t tile, const TileFrame& frame, Workspace& w, int64_t begin) const {
    const Canvas<S>& canvas = target.canvas;
    const int64_t size = int64_t(view.width) * view.height;
    S* transmittance = w.field[kTransmittanceOf];
    for (int i = 0; i < kTilePixels; ++i) transmittance[i] = absolute(transmittance[i]);
    const auto keep = [&](const auto* from, auto* to) { std::copy_n(from, kTilePixels, to + tile * kTilePixels); };
    keep(transmittance, canvas.transmittance);
    keep(w.last, canvas.last);
    if (target.pixels.first != nullptr) {
      keep(w.field[kFirst], target.pixels.first);
      keep(w.field[kSum], target.pixels.sum);
      keep(w.field[kSquare], target.pixels.square);
      keep(w.median, target.pixels.median);
    }
    frame.for_each_pixel([&](int i, int x, int y) {
      const int64_t pixel = int64_t(frame.y0 + y) * view.width + frame.x0 + x;
      for (int channel = 0; channel < 3; ++channel) {
        S value = w.field[kRedOf + channel][i];
        if (canvas.background != nullptr)
          value += transmittance[i] *
                   canvas.background[canvas.background_is_image ? channel * size + pixel : int64_t(channel)];
        canvas.image[channel * size + pixel] = value;
      }
      if (canvas.alpha != nullptr) canvas.alpha[pixel] = S(1) - transmittance[i];
      if constexpr (kWithMaps) {
        const auto put = [&](int map, S value) { target.maps[map * size + pixel] = value; };
        put(kMapDepth, w.field[kDepthOf][i]);
        put(kMapInverse, w.field[kSum][i] + w.field[kFirst][i] * (S(1) - transmittance[i]));
        for (int k = 0; k < 3; ++k) put(kMapNormal + k, w.field[kNormalX + k][i]);
        put(kMapDistortion, S(kDistortionScale) * w.field[kDistortionOf][i]);
        put(kMapMedian, w.field[kMedianOf][i]);
      }
    });
  }
};

template <class V, bool kWithMaps>
void blend_tiles(const View<Scalar<V>>& view, const Settings& settings, const Slots<Scalar<V>>& slots,
                 const Scalar<V>* planes, const Pairs<Scalar<V>>& pairs, const SurfelCanvas<Scalar<V>>& target) {
  using Blender = SurfelBlender<V, kWithMaps>;
  const Blender blender{view, slots, planes, pairs, target, Scalar<V>(1) / view.far};
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const std::vector<int32_t> order = tiles_by_work(pairs.tile_start, tiles);
  std::atomic<int64_t> next{0}, evaluated{0}, blended{0};
  parallel(settings.parallel, [&] {
    const auto w = std::make_unique<typename Blender::Workspace>();
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tiles;) blender(order[size_t(i)], *w);
    evaluated += w->evaluated;
    blended += w->blended;
  });
  if (target.canvas.counters != nullptr) target.canvas.counters[0] = evaluated, target.canvas.counters[1] = blended;
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                    \
  template <>                                                                                                   \
  void blend_surfels<S>(const View<S>& view, const Settings& settings, const Slots<S>& slots, const S* planes,  \
                        const Pairs<S>& pairs, const SurfelCanvas<S>& canvas) {                                 \
    canvas.maps != nullptr ? blend_tiles<V, true>(view, settings, slots, planes, pairs, canvas)                 \
                           : blend_tiles<V, false>(view, settings, slots, planes, pairs, canvas);               \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
