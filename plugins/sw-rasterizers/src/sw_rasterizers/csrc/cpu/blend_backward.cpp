// Backward compositing: every tile walks its list back to front and writes one row of sums per (splat, tile) pair.
//
// Rows are numbered splat-major (Pairs::origin), so a splat's rows lie together and are added up later in a fixed order:
// no atomics, and the same bits for any number of threads. Here a splat is the outer loop and the touched blocks the
// inner one: its nine sums stay in registers over the whole tile and are reduced across lanes once. Because the conic is
// constant over the tile, moments of v = dL/dsigma are enough; the derivatives are put together in project_backward.
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
  static constexpr int kSums = kMoments + 3 + 2;  // moments, RGB, absgrad

  const View<S>& view;
  const Settings& settings;
  const Slots<S>& slots;
  const Pairs<S>& pairs;
  const Canvas<S>& canvas;
  const CanvasGradient<S>& gradient;
  int geometry_channels;  // channels whose gradient reaches alpha; detached features come last
  int columns;            // of a row of sums
  S* sums;

  struct Workspace {
    TileStage<V> stage;
    LaneOffsets<S> offsets;
    alignas(64) S transmittance[kTilePixels];
    alignas(64) S behind[kTilePixels];
    alignas(64) int32_t last[kTilePixels];
    int32_t block_last[kBlocks];
    std::vector<S> image_gradient;  // [channels][kTilePixels]
    std::vector<S> channel_sums;    // [channels][L]
  };

  void operator()(int64_t tile, Workspace& w) const {
    const TileFrame frame(view, tile);
    const int64_t begin = pairs.tile_start[tile], end = pairs.tile_start[tile + 1];
    if (begin == end) return;
    load_pixels(tile, frame, w);
    const int64_t used = *std::max_element(w.block_last, w.block_last + kBlocks);
    // Splats that no pixel reached have no row of their own to fill but must not leave garbage.
    for (int64_t i = begin + used; i < end; ++i) std::fill_n(row(i), columns, S(0));
    for (int64_t stop = begin + used; stop > begin;) {
      const int64_t first = std::max(begin, begin + (stop - begin - 1) / kStage * kStage);
      const int count = int(stop - first);
      w.stage.load_splats(slots, pairs.slot + first, count);
      for (int k = count - 1; k >= 0; --k) blend_splat(frame, w, k, first, int32_t(first - begin) + k);
      stop = first;
    }
    if (gradient.median != nullptr) add_median(frame);
  }

  S* row(int64_t pair) const { return sums + int64_t(pairs.origin[pair]) * columns; }

  void load_pixels(int64_t tile, const TileFrame& frame, Workspace& w) const {
    const int64_t size = int64_t(view.width) * view.height;
    std::copy_n(canvas.transmittance + tile * kTilePixels, kTilePixels, w.transmittance);
    std::copy_n(canvas.last + tile * kTilePixels, kTilePixels, w.last);
    std::fill(w.image_gradient.begin(), w.image_gradient.end(), S(0));
    std::fill(w.behind, w.behind + kTilePixels, S(0));
    frame.for_each_pixel([&](int i, int x, int y) {
      const int64_t pixel = int64_t(frame.y0 + y) * view.width + frame.x0 + x;
      S behind = gradient.alpha != nullptr ? -gradient.alpha[pixel] : S(0);
      for (int channel = 0; channel < canvas.channels; ++channel) {
        const S g = gradient.image[channel * size + pixel];
        w.image_gradient[channel * kTilePixels + i] = g;
        if (canvas.background != nullptr && channel < canvas.color_channels)
          behind += g * canvas.background[canvas.background_is_image ? channel * size + pixel : int64_t(channel)];
      }
      w.behind[i] = w.transmittance[i] * behind;
    });
    for (int b = 0; b < kBlocks; ++b)
      w.block_last[b] = *std::max_element(w.last + b * kBlockPixels, w.last + (b + 1) * kBlockPixels);
  }

  void blend_splat(const TileFrame& frame, Workspace& w, int k, int64_t first, int32_t position) const {
    const auto& field = w.stage.field;
    const V zero = constant<V>(0), ceiling = constant<V>(kAlphaMax);
    const V a = V{} + field[kA][k], b = V{} + field[kB][k], c = V{} + field[kC][k], level = V{} + field[kLevel][k];
    const S u = field[kU][k], v = field[kV][k];
    const S* channel_value = kGeneral ? slots.channels + int64_t(pairs.slot[first + k]) * canvas.channels : nullptr;
    V sum[kSums];
    for (V& s : sum) s = zero;
    if constexpr (kGeneral) std::fill(w.channel_sums.begin(), w.channel_sums.end(), S(0));

    for (unsigned mask = pairs.blocks[first + k]; mask != 0; mask &= mask - 1) {
      const int block = __builtin_ctz(mask);
      if (position >= w.block_last[block]) continue;
      for (int pack = 0; pack < kPacks; ++pack) {
        const int at = block * kBlockPixels + pack * L;
        const V dx = (u - S(frame.x0 + TileFrame::pixel_x(block, 0) + 0.5)) - load<V>(w.offsets.x + pack * L);
        const V dy = (v - S(frame.y0 + TileFrame::pixel_y(block, 0) + 0.5)) - load<V>(w.offsets.y + pack * L);
        const V power = log2_alpha(dx, dy, a, b, c, level);
        const auto touched = (power >= constant<V>(kLog2AlphaMin)) & (load<I>(w.last + at) > position);
        const V unclamped = select(touched, exp_2(power), zero);
        const V alpha = minimum(ceiling, unclamped);

        const S* g = w.image_gradient.data() + at;
        V phi, weight;
        if constexpr (kGeneral) {
          phi = zero;
          for (int channel = 0; channel < geometry_channels; ++channel)
            phi += channel_value[channel] * load<V>(g + channel * kTilePixels);
        } else {
          phi = field[kRed][k] * load<V>(g) + field[kGreen][k] * load<V>(g + kTilePixels) +
                field[kBlue][k] * load<V>(g + 2 * kTilePixels);
        }
        V transmittance = load<V>(w.transmittance + at), behind = load<V>(w.behind + at);
        const V alpha_gradient = composite_backward(alpha, phi, transmittance, behind, weight);
        store(w.transmittance + at, transmittance);
        store(w.behind + at, behind);

        if constexpr (kGeneral) {
          for (int channel = 0; channel < canvas.channels; ++channel) {
            S* total = w.channel_sums.data() + channel * L;
            store(total, load<V>(total) + weight * load<V>(g + channel * kTilePixels));
          }
        } else {
          for (int channel = 0; channel < 3; ++channel)
            sum[kMoments + channel] += weight * load<V>(g + channel * kTilePixels);
        }
        // The clamp at 0.99 stops the gradient, unless it is asked to pass.
        const V through = settings.pass_clamp ? unclamped : select(unclamped <= ceiling, unclamped, zero);
        const V moment = -(through * alpha_gradient);
        const V mx = moment * dx, my = moment * dy;
        sum[kV0] += moment;
        sum[kVx] += mx;
        sum[kVy] += my;
        sum[kVxx] += mx * dx;
        sum[kVxy] += mx * dy;
        sum[kVyy] += my * dy;
        if constexpr (kAbsgrad) {
          sum[kMoments + 3] += absolute(constant<V>(2) * a * mx + b * my);
          sum[kMoments + 4] += absolute(b * mx + constant<V>(2) * c * my);
        }
      }
    }

    S* out = row(first + k);
    for (int i = 0; i < kMoments; ++i) out[i] = horizontal_sum(sum[i]);
    if constexpr (kGeneral) {
      for (int channel = 0; channel < canvas.channels; ++channel)
        out[kMoments + channel] = horizontal_sum(load<V>(w.channel_sums.data() + channel * L));
    } else {
      for (int channel = 0; channel < 3; ++channel) out[kMoments + channel] = horizontal_sum(sum[kMoments + channel]);
    }
    if constexpr (kAbsgrad)
      for (int i = 0; i < 2; ++i)  // A = -Ka log2(e)/2 and so on: back to natural units
        out[kMoments + canvas.channels + i] = S(kLn2) * horizontal_sum(sum[kMoments + 3 + i]);
    if (gradient.median != nullptr) out[columns - 1] = S(0);
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
  const int columns = pair_columns(canvas.channels, kAbsgrad, gradient.median != nullptr);
  const Backward backward{view,     settings, slots, pairs, canvas, gradient, canvas.channels - detached,
                          columns, sums};
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const std::vector<int32_t> order = tiles_by_work(pairs.tile_start, tiles);
  std::atomic<int64_t> next{0};
  parallel(settings.threads, [&](int, int) {
    const auto w = std::make_unique<typename Backward::Workspace>();
    w->image_gradient.assign(size_t(canvas.channels) * kTilePixels, Scalar<V>(0));
    w->channel_sums.assign(size_t(canvas.channels) * lanes_of<V>, Scalar<V>(0));
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tiles;) backward(order[size_t(i)], *w);
  });
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                      \
  template <>                                                                                                     \
  void blend_backward<S>(const View<S>& view, const Settings& settings, const Slots<S>& slots,                    \
                         const Pairs<S>& pairs, const Canvas<S>& canvas, const CanvasGradient<S>& gradient,       \
                         int detached, S* sums) {                                                                 \
    const auto run = slots.channels != nullptr                                                                    \
                         ? (settings.absgrad ? backward_tiles<V, true, true> : backward_tiles<V, true, false>)    \
                         : (settings.absgrad ? backward_tiles<V, false, true> : backward_tiles<V, false, false>); \
    run(view, settings, slots, pairs, canvas, gradient, detached, sums);                                          \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
