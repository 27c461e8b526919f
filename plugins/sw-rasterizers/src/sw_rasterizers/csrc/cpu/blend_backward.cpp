// Backward compositing: every tile walks its list back to front and writes one row of sums per (splat, tile) pair.
//
// Rows are numbered splat-major (Pairs::origin), so a splat's rows lie together and are added up later in a fixed
// order: no atomics, and the same bits for any number of threads. Here a splat is the outer loop and the touched blocks
// the inner one: its nine sums stay in registers over the whole tile and are reduced across lanes once. Because the
// conic is constant over the tile, moments of v = dL/dsigma are enough; the derivatives are put together in
// project_backward.
#include <limits>
#include <memory>

#include "parallel.h"
#include "tile_stage.h"

namespace SW_ARCH {
namespace {

template <class V, bool kGeneral, bool kAbsgrad>
struct TileBackward {
  using S = Scalar<V>;
  using I = IntOf<V>;
  static constexpr int L = lanes_of<V>;
  static constexpr int kPacks = kBlockPixels / L;
  static constexpr int kPixels = kTilePixels + kBlockPixels;  // with the spare block

  const View<S>& view;
  const Settings& settings;
  const Slots<S>& slots;
  const Pairs<S>& pairs;
  const Canvas<S>& canvas;
  const CanvasGradient<S>& gradient;
  int geometry_channels;  // channels whose gradient reaches alpha; detached features come last
  int columns;            // of a row of sums
  S* sums;

  static constexpr int kAhead = 8;  // pairs between prefetch and use of a record

  struct Workspace {
    PixelCentres<S, kPixels> centres;
    alignas(64) S transmittance[kPixels];
    alignas(64) S behind[kPixels];
    alignas(64) int32_t last[kPixels];
    V clamp_limit;                  // of the unclamped alpha, above which its gradient is 0
    std::vector<S> image_gradient;  // [channels][kPixels]
    std::vector<S> channel_sums;    // [channels][L]
  };

  void operator()(int64_t tile, Workspace& w) const {
    const TileFrame frame(view, tile);
    const int64_t begin = pairs.tile_start[tile], end = pairs.tile_start[tile + 1];
    if (begin == end) return;
    load_pixels(tile, frame, w);
    const int64_t used = *std::max_element(w.last, w.last + kTilePixels);
    // Splats that no pixel reached have no row of their own to fill but must not leave garbage.
    for (int64_t i = begin + used; i < end; ++i) std::fill_n(row(i), columns, S(0));
    for (int64_t i = begin + used; i-- > begin;) {
      if (i >= begin + kAhead) __builtin_prefetch(slots.records + int64_t(pairs.slot[i - kAhead]) * kRecord);
      blend_splat(w, i, int32_t(i - begin));
    }
    if (gradient.median != nullptr) add_median(frame);
  }

  S* row(int64_t pair) const { return sums + int64_t(pairs.origin[pair]) * columns; }

  void load_pixels(int64_t tile, const TileFrame& frame, Workspace& w) const {
    const int64_t size = int64_t(view.width) * view.height;
    w.centres.set(frame);
    w.clamp_limit = constant<V>(settings.pass_clamp ? double(std::numeric_limits<float>::max()) : kAlphaMax);
    std::fill_n(w.transmittance, kPixels, S(1));
    std::fill_n(w.last, kPixels, 0);
    std::fill_n(w.behind, kPixels, S(0));
    std::copy_n(canvas.transmittance + tile * kTilePixels, kTilePixels, w.transmittance);
    std::copy_n(canvas.last + tile * kTilePixels, kTilePixels, w.last);
    std::fill(w.image_gradient.begin(), w.image_gradient.end(), S(0));
    frame.for_each_pixel([&](int i, int x, int y) {
      const int64_t pixel = int64_t(frame.y0 + y) * view.width + frame.x0 + x;
      S behind = gradient.alpha != nullptr ? -gradient.alpha[pixel] : S(0);
      for (int channel = 0; channel < canvas.channels; ++channel) {
        const S g = gradient.image[channel * size + pixel];
        w.image_gradient[channel * kPixels + i] = g;
        if (canvas.background != nullptr && channel < canvas.color_channels)
          behind += g * canvas.background[canvas.background_is_image ? channel * size + pixel : int64_t(channel)];
      }
      w.behind[i] = w.transmittance[i] * behind;
    });
  }

  // The sums of one pair, each a pack over the tile's pixels.
  struct Sums {
    V v0{}, x{}, y{}, xx{}, xy{}, yy{}, color[3]{}, absolute[2]{};
  };

  void blend_splat(Workspace& w, int64_t pair, int32_t position) const {
    const S* record = slots.records + int64_t(pairs.slot[pair]) * kRecord;
    const S* channels = kGeneral ? slots.channels + int64_t(pairs.slot[pair]) * canvas.channels : nullptr;
    Sums sums_of_pair;
    if constexpr (kGeneral) std::fill(w.channel_sums.begin(), w.channel_sums.end(), S(0));

    // Two blocks a turn: small splats touch one or two, and a loop that ends there after one turn is predicted well.
    // The second may be the spare block behind the tile, which no splat changes.
    unsigned mask = pairs.blocks[pair];
    while (mask != 0) {
      const int first = __builtin_ctz(mask);
      mask &= mask - 1;
      const int second = mask != 0 ? __builtin_ctz(mask) : kBlocks;
      mask &= mask - 1;  // 0 stays 0
      for (int pack = 0; pack < kPacks; ++pack) {
        blend_pack(w, first * kBlockPixels + pack * L, position, record, channels, sums_of_pair);
        blend_pack(w, second * kBlockPixels + pack * L, position, record, channels, sums_of_pair);
      }
    }
    write_row(w, sums_of_pair, row(pair));
  }

  SW_HD void blend_pack(Workspace& w, int at, int32_t position, const S* record, const S* channels, Sums& sum) const {
    const V zero = constant<V>(0), ceiling = constant<V>(kAlphaMax);
    const V a = V{} + record[kA], b = V{} + record[kB], c = V{} + record[kC];
    const V dx = record[kU] - load<V>(w.centres.x + at), dy = record[kV] - load<V>(w.centres.y + at);
    const V power = log2_alpha(dx, dy, a, b, c, V{} + record[kLevel]);
    const auto touched = (power >= constant<V>(kLog2AlphaMin)) & (load<I>(w.last + at) > position);
    const V unclamped = select(touched, exp_2(power), zero);
    const V alpha = minimum(ceiling, unclamped);

    const S* gradient_at = w.image_gradient.data() + at;
    const auto g = [&](int channel) { return load<V>(gradient_at + channel * kPixels); };
    V phi, weight;
    if constexpr (kGeneral) {
      phi = zero;
      for (int channel = 0; channel < geometry_channels; ++channel) phi += channels[channel] * g(channel);
    } else {
      phi = record[kRed] * g(0) + record[kGreen] * g(1) + record[kBlue] * g(2);
    }
    V transmittance = load<V>(w.transmittance + at), behind = load<V>(w.behind + at);
    const V alpha_gradient = composite_backward(alpha, phi, transmittance, behind, weight);
    store(w.transmittance + at, transmittance);
    store(w.behind + at, behind);

    if constexpr (kGeneral) {
      for (int channel = 0; channel < canvas.channels; ++channel) {
        S* total = w.channel_sums.data() + channel * L;
        store(total, load<V>(total) + weight * g(channel));
      }
    } else {
      for (int channel = 0; channel < 3; ++channel) sum.color[channel] += weight * g(channel);
    }
    // The clamp at 0.99 stops the gradient, unless it is asked to pass: then the unclamped alpha stands in front.
    const V through = select(unclamped <= w.clamp_limit, unclamped, zero);
    const V moment = -(through * alpha_gradient);
    const V mx = moment * dx, my = moment * dy;
    sum.v0 += moment;
    sum.x += mx;
    sum.y += my;
    sum.xx += mx * dx;
    sum.xy += mx * dy;
    sum.yy += my * dy;
    if constexpr (kAbsgrad) {
      if (settings.fragments) {
        sum.absolute[0] += moment * moment;
        sum.absolute[1] += select(touched, constant<V>(1), zero);
      } else {
        sum.absolute[0] += absolute(constant<V>(2) * a * mx + b * my);
        sum.absolute[1] += absolute(b * mx + constant<V>(2) * c * my);
      }
    }
  }

  void write_row(Workspace& w, const Sums& sum, S* out) const {
    // A = -Ka log2(e)/2 and so on: absgrad goes back to natural units.
    const V ln2 = constant<V>(settings.fragments ? 1 : kLn2);
    V packs[kPlainColumns] = {sum.v0,
                              sum.x,
                              sum.y,
                              sum.xx,
                              sum.xy,
                              sum.yy,
                              sum.color[0],
                              sum.color[1],
                              sum.color[2],
                              ln2 * sum.absolute[0],
                              ln2 * sum.absolute[1],
                              V{}};
    if constexpr (!kGeneral) {
      lane_sums<V, kPlainColumns>(packs, out);
    } else {
      alignas(64) S moments[kPlainColumns];
      lane_sums<V, kPlainColumns>(packs, moments);
      out = std::copy_n(moments, int(kMoments), out);
      for (int channel = 0; channel < canvas.channels; ++channel)
        *out++ = horizontal_sum(load<V>(w.channel_sums.data() + channel * L));
      if constexpr (kAbsgrad) out = std::copy_n(moments + kMoments + 3, 2, out);
      if (gradient.median != nullptr) *out = S(0);
    }
  }

  // The median depth is the depth of one splat: its pixel's gradient goes straight to that splat.
  void add_median(const TileFrame& frame) const {
    frame.for_each_pixel([&](int, int x, int y) {
      const int64_t pixel = int64_t(frame.y0 + y) * view.width + frame.x0 + x;
      const int32_t pair = canvas.median_pair[pixel];
      if (pair >= 0) sums[int64_t(pair) * columns + columns - 1] += gradient.median[pixel];
    });
  }
};

template <class V, bool kGeneral, bool kAbsgrad>
void backward_tiles(const View<Scalar<V>>& view, const Settings& settings, const Slots<Scalar<V>>& slots,
                    const Pairs<Scalar<V>>& pairs, const Canvas<Scalar<V>>& canvas,
                    const CanvasGradient<Scalar<V>>& gradient, int detached, Scalar<V>* sums) {
  using Backward = TileBackward<V, kGeneral, kAbsgrad>;
  const int columns = pair_columns(!kGeneral, canvas.channels, kAbsgrad, gradient.median != nullptr);
  const Backward backward{view, settings, slots, pairs, canvas, gradient, canvas.channels - detached, columns, sums};
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const std::vector<int32_t> order = tiles_by_work(pairs.tile_start, tiles);
  std::atomic<int64_t> next{0};
  parallel(settings.parallel, [&] {
    const auto w = std::make_unique<typename Backward::Workspace>();
    w->image_gradient.assign(size_t(canvas.channels) * Backward::kPixels, Scalar<V>(0));
    w->channel_sums.assign(size_t(canvas.channels) * lanes_of<V>, Scalar<V>(0));
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tiles;) backward(order[size_t(i)], *w);
  });
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                          \
  template <>                                                                                                         \
  void blend_backward<S>(const View<S>& view, const Settings& settings, const Slots<S>& slots, const Pairs<S>& pairs, \
                         const Canvas<S>& canvas, const CanvasGradient<S>& gradient, int detached, S* sums) {         \
    const auto run = slots.channels != nullptr                                                                        \
                         ? (settings.absgrad ? backward_tiles<V, true, true> : backward_tiles<V, true, false>)        \
                         : (settings.absgrad ? backward_tiles<V, false, true> : backward_tiles<V, false, false>);     \
    run(view, settings, slots, pairs, canvas, gradient, detached, sums);                                              \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
