// Forward compositing of one tile at a time.
//
// Every stage of kStage splats is dealt to the blocks of the tile by their masks; then each block runs through its
// own list with its pixels' transmittance, colours and last position in registers: no load or store of pixel state per
// splat, one broadcast of each splat field.
#include <memory>

#include "parallel.h"
#include "tile_stage.h"

namespace SW_ARCH {
namespace {

template <class V, bool kGeneral>
struct TileBlender {
  using S = Scalar<V>;
  using I = IntOf<V>;
  static constexpr int L = lanes_of<V>;
  static constexpr int kPacks = kBlockPixels / L;

  const View<S>& view;
  const Settings& settings;
  const Slots<S>& slots;
  const Pairs<S>& pairs;
  const Canvas<S>& canvas;

  struct Workspace {
    TileStage<V> stage;
    PixelCentres<S> centres;
    uint8_t list[kBlocks][kStage];
    int length[kBlocks];
    uint32_t drawn[kStage];  // blocks in which any pixel draws the splat
    alignas(64) S transmittance[kTilePixels];
    alignas(64) int32_t last[kTilePixels];
    alignas(64) int32_t median[kTilePixels];  // list position of the splat that crosses T = 1/2
    std::vector<S> color;                     // [channels][kTilePixels]
    int64_t evaluated = 0, blended = 0;
  };

  void operator()(int64_t tile, Workspace& w) const {
    const TileFrame frame(view, tile);
    const int64_t begin = pairs.tile_start[tile], end = pairs.tile_start[tile + 1];
    w.centres.set(frame);
    std::fill(w.color.begin(), w.color.end(), S(0));
    std::fill(w.last, w.last + kTilePixels, 0);
    std::fill(w.median, w.median + kTilePixels, 0);
    std::fill(w.transmittance, w.transmittance + kTilePixels, S(-1));  // outside the image: done
    frame.for_each_pixel([&](int i, int, int) { w.transmittance[i] = S(1); });
    unsigned live = 0;
    for (int b = 0; b < kBlocks; ++b) live |= unsigned(is_live(w, b)) << b;

    for (int64_t first = begin; first < end && live != 0; first += kStage) {
      const int count = int(std::min<int64_t>(kStage, end - first));
      w.stage.load_splats(slots, pairs.slot + first, count, end - first);
      w.stage.find_blocks(frame, count);
      std::fill(w.length, w.length + kBlocks, 0);
      for (int k = 0; k < count; ++k) {
        w.drawn[k] = 0;
        for (unsigned mask = unsigned(w.stage.blocks[k]) & live; mask != 0; mask &= mask - 1) {
          const int b = __builtin_ctz(mask);
          w.list[b][w.length[b]++] = uint8_t(k);
        }
      }
      for (int b = 0; b < kBlocks; ++b) {
        if (w.length[b] == 0) continue;
        if (canvas.counters != nullptr) count_pairs(w, b);
        for (int pack = 0; pack < kPacks; ++pack) blend_pack(w, b, pack, first, int32_t(first - begin));
        if (!is_live(w, b)) live &= ~(1u << b);
      }
      // Where rounding or the shape of a small splat leaves a block without a drawn pixel, backward need not look.
      if (pairs.blocks != nullptr) std::copy_n(w.drawn, count, pairs.blocks + first);
    }
    write(tile, frame, w, begin);
  }

  static bool is_live(const Workspace& w, int block) {
    for (int i = 0; i < kBlockPixels; ++i)
      if (w.transmittance[block * kBlockPixels + i] > S(0)) return true;
    return false;
  }

  void blend_pack(Workspace& w, int block, int pack, int64_t first, int32_t base) const {
    const int at = block * kBlockPixels + pack * L;
    const auto& field = w.stage.field;
    const V x = load<V>(w.centres.x + at), y = load<V>(w.centres.y + at);
    const V zero = constant<V>(0), threshold = constant<V>(kLog2AlphaMin), ceiling = constant<V>(kAlphaMax);
    V transmittance = load<V>(w.transmittance + at);
    I last = load<I>(w.last + at), median{};
    V color[3];
    if constexpr (kGeneral)
      median = load<I>(w.median + at);
    else
      for (int channel = 0; channel < 3; ++channel)
        color[channel] = load<V>(w.color.data() + channel * kTilePixels + at);

    const uint8_t* list = w.list[block];
    for (int n = 0; n < w.length[block]; ++n) {
      const int k = list[n];
      const V level = V{} + field[kLevel][k];
      const V power = log2_alpha<V>(field[kU][k] - x, field[kV][k] - y, V{} + field[kA][k], V{} + field[kB][k],
                                    V{} + field[kC][k], level);
      const auto touched = power >= threshold;
      const V alpha = select(touched, minimum(ceiling, exp_2(power)), zero);
      const V before = transmittance;
      const V weight = composite(alpha, transmittance);
      const auto drawn = weight > zero;
      w.drawn[k] |= uint32_t(any(drawn)) << block;
      last = select(drawn, I{} + (base + k + 1), last);
      if constexpr (kGeneral) {
        median = select(drawn & (before > constant<V>(0.5)), I{} + (base + k + 1), median);
        const S* value = slots.channels + int64_t(pairs.slot[first + k]) * canvas.channels;
        for (int channel = 0; channel < canvas.channels; ++channel) {
          S* sum = w.color.data() + channel * kTilePixels + at;
          store(sum, load<V>(sum) + weight * value[channel]);
        }
      } else {
        color[0] += weight * field[kRed][k];
        color[1] += weight * field[kGreen][k];
        color[2] += weight * field[kBlue][k];
      }
      if ((n & 15) == 15 && !any(transmittance > zero)) break;
    }

    store(w.transmittance + at, transmittance);
    store(w.last + at, last);
    if constexpr (kGeneral)
      store(w.median + at, median);
    else
      for (int channel = 0; channel < 3; ++channel) store(w.color.data() + channel * kTilePixels + at, color[channel]);
  }

  // The counting mode: pixel-splat pairs whose exponent is evaluated, and those that are blended.
  static void count_pairs(Workspace& w, int block) {
    const auto& field = w.stage.field;
    for (int i = 0; i < kBlockPixels; ++i) {
      S transmittance = w.transmittance[block * kBlockPixels + i];
      const S x = w.centres.x[block * kBlockPixels + i], y = w.centres.y[block * kBlockPixels + i];
      for (int n = 0; n < w.length[block]; ++n) {
        const int k = w.list[block][n];
        const S power = log2_alpha<S>(field[kU][k] - x, field[kV][k] - y, field[kA][k], field[kB][k], field[kC][k],
                                      field[kLevel][k]);
        ++w.evaluated;
        if (!(power >= S(kLog2AlphaMin))) continue;
        w.blended += composite(minimum(S(kAlphaMax), exp_2(power)), transmittance) > S(0);
      }
    }
  }

  void write(int64_t tile, const TileFrame& frame, Workspace& w, int64_t begin) const {
    const int64_t size = int64_t(view.width) * view.height;
    for (int i = 0; i < kTilePixels; ++i) w.transmittance[i] = absolute(w.transmittance[i]);
    std::copy(w.transmittance, w.transmittance + kTilePixels, canvas.transmittance + tile * kTilePixels);
    std::copy(w.last, w.last + kTilePixels, canvas.last + tile * kTilePixels);
    frame.for_each_pixel([&](int i, int x, int y) {
      const int64_t pixel = int64_t(frame.y0 + y) * view.width + frame.x0 + x;
      for (int channel = 0; channel < canvas.channels; ++channel) {
        S value = w.color[channel * kTilePixels + i];
        if (canvas.background != nullptr && channel < canvas.color_channels)
          value += w.transmittance[i] *
                   canvas.background[canvas.background_is_image ? channel * size + pixel : int64_t(channel)];
        canvas.image[channel * size + pixel] = value;
      }
      if (canvas.alpha != nullptr) canvas.alpha[pixel] = S(1) - w.transmittance[i];
      if (canvas.median != nullptr) {
        const int32_t position = w.median[i];
        const int64_t pair = begin + position - 1;
        canvas.median[pixel] = position == 0 ? S(0) : slots.records[int64_t(pairs.slot[pair]) * kRecord + kDepth];
        if (canvas.median_pair != nullptr) canvas.median_pair[pixel] = position == 0 ? -1 : pairs.origin[pair];
      }
    });
  }
};

template <class V, bool kGeneral>
void blend_tiles(const View<Scalar<V>>& view, const Settings& settings, const Slots<Scalar<V>>& slots,
                 const Pairs<Scalar<V>>& pairs, const Canvas<Scalar<V>>& canvas) {
  using Blender = TileBlender<V, kGeneral>;
  const Blender blender{view, settings, slots, pairs, canvas};
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const std::vector<int32_t> order = tiles_by_work(pairs.tile_start, tiles);
  std::atomic<int64_t> next{0}, evaluated{0}, blended{0};
  parallel(settings.parallel, [&] {
    const auto w = std::make_unique<typename Blender::Workspace>();
    w->color.assign(size_t(canvas.channels) * kTilePixels, Scalar<V>(0));
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tiles;) blender(order[size_t(i)], *w);
    evaluated += w->evaluated;
    blended += w->blended;
  });
  if (canvas.counters != nullptr) canvas.counters[0] = evaluated, canvas.counters[1] = blended;
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                 \
  template <>                                                                                                \
  void blend<S>(const View<S>& view, const Settings& settings, const Slots<S>& slots, const Pairs<S>& pairs, \
                const Canvas<S>& canvas) {                                                                   \
    slots.channels != nullptr ? blend_tiles<V, true>(view, settings, slots, pairs, canvas)                   \
                              : blend_tiles<V, false>(view, settings, slots, pairs, canvas);                 \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
