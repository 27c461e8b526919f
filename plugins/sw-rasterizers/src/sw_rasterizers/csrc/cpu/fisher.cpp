// How the image reacts to a splat: squared derivatives and changes by its removal, one row of sums per (splat, tile)
// pair, and the Fisher blocks that are put together from such sums.
//
// Tiles are walked back to front, as in blend_backward, because the light behind a splat must be known; `blend` has
// left the last transmittance, the last splat and the touched blocks. Rows are added up in float64.
#include <algorithm>
#include <cstring>
#include <limits>
#include <memory>
#include <type_traits>

#include "gather.h"
#include "parallel.h"
#include "score_kernels.h"
#include "tile_stage.h"

namespace SW_ARCH {
namespace {

template <class V, bool kForFisher>
struct TileSensitivity {
  using S = Scalar<V>;
  using I = IntOf<V>;
  static constexpr int L = lanes_of<V>;
  static constexpr int kPacks = kBlockPixels / L;
  static constexpr int kAhead = 8;                          // pairs between prefetch and use of a record and a row
  static constexpr int kLine = 64 / int(sizeof(S));         // values of a cache line

  const View<S>& view;
  const Settings& settings;
  const Slots<S>& slots;
  const Pairs<S>& pairs;
  const Canvas<S>& canvas;
  const Scores<S>* scores;
  S* sums;

  struct Workspace {
    PixelCentres<S> centres;
    alignas(64) S transmittance[kTilePixels];
    alignas(64) S behind[3][kTilePixels];
    alignas(64) int32_t last[kTilePixels];
    alignas(64) S weight[kForFisher ? 1 : kMaxScores][3][kTilePixels];  // of the pixel; of kRemoval the residual
    V clamp_limit;  // of the unclamped alpha, above which its gradient is 0
  };

  int columns() const { return kForFisher ? int(kFisherSums) : scores->count; }
  S* row(int64_t pair) const { return sums + int64_t(pairs.origin[pair]) * columns(); }

  void operator()(int64_t tile, Workspace& w) const {
    const TileFrame frame(view, tile);
    const int64_t begin = pairs.tile_start[tile], end = pairs.tile_start[tile + 1];
    if (begin == end) return;
    load_pixels(tile, frame, w);
    const int64_t used = *std::max_element(w.last, w.last + kTilePixels);
    for (int64_t i = begin + used; i < end; ++i) std::fill_n(row(i), columns(), S(0));
    for (int64_t i = begin + used; i-- > begin;) {
      if (i >= begin + kAhead) {
        __builtin_prefetch(slots.records + int64_t(pairs.slot[i - kAhead]) * kRecord);
        const S* ahead = row(i - kAhead);
        for (int k = 0; k < columns(); k += kLine) __builtin_prefetch(ahead + k, 1);
      }
      add_splat(w, i, int32_t(i - begin));
    }
  }

  void load_pixels(int64_t tile, const TileFrame& frame, Workspace& w) const {
    const int64_t size = int64_t(view.width) * view.height;
    w.centres.set(frame);
    w.clamp_limit = constant<V>(settings.pass_clamp ? double(std::numeric_limits<float>::max()) : kAlphaMax);
    std::copy_n(canvas.transmittance + tile * kTilePixels, kTilePixels, w.transmittance);
    std::copy_n(canvas.last + tile * kTilePixels, kTilePixels, w.last);
    for (auto& light : w.behind) std::fill_n(light, kTilePixels, S(0));
    frame.for_each_pixel([&](int i, int x, int y) {
      const int64_t pixel = int64_t(frame.y0 + y) * view.width + frame.x0 + x;
      for (int c = 0; canvas.background != nullptr && c < 3; ++c)
        w.behind[c][i] =
            w.transmittance[i] * canvas.background[canvas.background_is_image ? c * size + pixel : int64_t(c)];
      if constexpr (!kForFisher)
        for (int s = 0; s < scores->count; ++s)
          for (int c = 0; scores->of[s].weight != nullptr && c < (scores->of[s].kind == kRemoval ? 3 : 1); ++c)
            w.weight[s][c][i] = scores->of[s].weight[c * size + pixel];
    });
  }

  void add_splat(Workspace& w, int64_t pair, int32_t position) const {
    const S* record = slots.records + int64_t(pairs.slot[pair]) * kRecord;
    constexpr int kTotals = kForFisher ? int(kFisherSums) : int(kMaxScores);
    V total[kTotals];
    for (int k = 0; k < columns(); ++k) total[k] = constant<V>(0);
    for (unsigned mask = pairs.blocks[pair]; mask != 0; mask &= mask - 1)
      for (int pack = 0; pack < kPacks; ++pack)
        add_pack(w, __builtin_ctz(mask) * kBlockPixels + pack * L, position, record, total);
    if constexpr (kForFisher)
      lane_sums<V, kFisherSums>(total, row(pair));
    else
      for (int s = 0; s < scores->count; ++s) row(pair)[s] = horizontal_sum(total[s]);
  }

  SW_HD void add_pack(Workspace& w, int at, int32_t position, const S* record, V* total) const {
    const V zero = constant<V>(0), one = constant<V>(1), ceiling = constant<V>(kAlphaMax);
    const V dx = record[kU] - load<V>(w.centres.x + at), dy = record[kV] - load<V>(w.centres.y + at);
    const V power = log2_alpha(dx, dy, V{} + record[kA], V{} + record[kB], V{} + record[kC], V{} + record[kLevel]);
    const auto touched = (power >= constant<V>(kLog2AlphaMin)) & (load<I>(w.last + at) > position);
    const V unclamped = select(touched, exp_2(power), zero), alpha = minimum(ceiling, unclamped);
    const auto through = touched & (unclamped <= w.clamp_limit);

    const V gain = reciprocal(one - alpha);
    const V transmittance = load<V>(w.transmittance + at) * gain, weight = alpha * transmittance;
    store(w.transmittance + at, transmittance);
    V slope[3];  // d image_c / d alpha
    for (int c = 0; c < 3; ++c) {
      const V color = V{} + record[kRed + c];
      const V behind = load<V>(w.behind[c] + at);
      slope[c] = transmittance * color - behind * gain;
      store(w.behind[c] + at, behind + weight * color);
    }
    if constexpr (kForFisher) {
      V v[3];
      for (int c = 0; c < 3; ++c) v[c] = -(unclamped * select(through, slope[c], zero));
      add_fisher_pixel(dx, dy, v, weight, total);
    } else {
      const V sum = select(through, slope[0] + slope[1] + slope[2], zero), square = sum * sum;
      for (int s = 0; s < scores->count; ++s) {
        const auto plane = [&](int c) { return load<V>(w.weight[s][c] + at); };
        if (scores->of[s].kind == kRemoval) {
          const V residual[3] = {plane(0), plane(1), plane(2)};
          total[s] += removal_change(alpha, slope, residual);
        } else if (scores->of[s].weight != nullptr) {
          total[s] += square * plane(0);
        } else {
          total[s] += square;
        }
      }
    }
  }
};

template <class V, bool kForFisher>
void sensitivity_tiles(const View<Scalar<V>>& view, const Settings& settings, const Slots<Scalar<V>>& slots,
                       const Pairs<Scalar<V>>& pairs, const Canvas<Scalar<V>>& canvas,
                       const Sensitivity<Scalar<V>>& what, Scalar<V>* sums) {
  using Tiles = TileSensitivity<V, kForFisher>;
  const Tiles walk{view, settings, slots, pairs, canvas, what.scores, sums};
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const std::vector<int32_t> order = tiles_by_work(pairs.tile_start, tiles);
  std::atomic<int64_t> next{0};
  parallel(settings.parallel, [&] {
    const auto w = std::make_unique<typename Tiles::Workspace>();
    std::fill_n(&w->weight[0][0][0], sizeof w->weight / sizeof(Scalar<V>), Scalar<V>(0));
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tiles;) walk(order[size_t(i)], *w);
  });
}

// As many doubles as V has lanes.
#if SW_LANES > 1
typedef double PackD __attribute__((vector_size(8 * SW_LANES)));
template <class V>
using Doubles = std::conditional_t<(lanes_of<V> > 1), PackD, double>;
SW_HD void widen(const PackF& from, PackD& to) { to = __builtin_convertvector(from, PackD); }
#else
template <class V>
using Doubles = double;
SW_HD void widen(float from, double& to) { to = double(from); }
#endif
SW_HD void widen(double from, double& to) { to = from; }

template <class V>
void add_fisher_pack(const View<Scalar<V>>& view, const Gaussians<Scalar<V>>& g, const Settings& settings,
                     const Slots<Scalar<V>>& slots, const Scalar<V>* sums, int64_t first, int64_t end, double* blocks) {
  using S = Scalar<V>;
  constexpr int L = lanes_of<V>;
  const int lanes = int(std::min<int64_t>(end - first, L));
  alignas(64) int32_t rows[L];
  for (int i = 0; i < L; ++i) rows[i] = slots.index[first + (i < lanes ? i : lanes - 1)];
  Geometry<V> in;
  gather_rows<V, 3>(g.means, 3, rows, in.mean);
  gather_rows<V, 3>(g.scales, 3, rows, in.scale);
  gather_rows<V, 4>(g.quats, 4, rows, in.quat);
  V packs[kTheta][kPositions];
  fisher_basis(view, in, S(settings.scale_modifier), S(settings.eps2d), settings.original_jacobian, packs);

  using D = Doubles<V>;
  alignas(64) double total[kFisherSums][L] = {}, color[9][L] = {};
  for (int i = 0; i < lanes; ++i) {
    const int64_t slot = first + i;
    const S* row = sums + int64_t(slots.run[slot].first) * kFisherSums;
    for (int32_t n = 0; n < slots.run[slot].count; ++n, row += kFisherSums)
      for (int k = 0; k < kFisherSums; ++k) total[k][i] += double(row[k]);
    if (slots.color_slope != nullptr)
      for (int k = 0; k < 9; ++k)
        if ((slots.clamped[slot] >> (k / 3) & 1) == 0) color[k][i] = double(slots.color_slope[slot * 9 + k]);
  }
  D wide[kFisherSums], slope[9], basis[kTheta][kPositions], block[kFisher];
  std::memcpy(wide, total, sizeof total);
  std::memcpy(slope, color, sizeof color);
  for (int a = 0; a < kTheta; ++a)
    for (int k = 0; k < kPositions; ++k) widen(packs[a][k], basis[a][k]);
  fisher_block(basis, wide, slope, block);
  alignas(64) double found[kFisher][L];
  std::memcpy(found, block, sizeof block);
  for (int i = 0; i < lanes; ++i) {
    if (slots.run[first + i].count == 0) continue;  // dropped: its values have no meaning
    double* to = blocks + int64_t(rows[i]) * kFisher;
    for (int k = 0; k < kFisher; ++k) to[k] += found[k][i];
  }
}

}  // namespace

#define SW_INSTANTIATE(S, V)                                                                                      \
  template <>                                                                                                     \
  void sensitivity_pairs<S>(const View<S>& view, const Settings& settings, const Slots<S>& slots,                 \
                            const Pairs<S>& pairs, const Canvas<S>& canvas, const Sensitivity<S>& what, S* sums) { \
    what.fisher ? sensitivity_tiles<V, true>(view, settings, slots, pairs, canvas, what, sums)                    \
                : sensitivity_tiles<V, false>(view, settings, slots, pairs, canvas, what, sums);                  \
  }                                                                                                               \
  template <>                                                                                                     \
  void add_fisher<S>(const View<S>& view, const Gaussians<S>& g, const Settings& settings, const Slots<S>& slots, \
                     const S* sums, double* blocks) {                                                             \
    parallel_dynamic(settings.parallel, (g.count + kChunk - 1) / kChunk, [&](int64_t chunk) {                      \
      const int64_t begin = chunk * kChunk, end = begin + slots.per_chunk[chunk];                                 \
      for (int64_t s = begin; s < end; s += lanes_of<V>)                                                          \
        add_fisher_pack<V>(view, g, settings, slots, sums, s, end, blocks);                                       \
    });                                                                                                           \
  }
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
