// Contribution sums: every tile walks its list front to back and writes one row per (splat, tile) pair.
//
// A splat is the outer loop and the touched blocks the inner one, so that a row is reduced across lanes once. Rows are
// numbered splat-major and added up in that order, in float64: no atomics, the same bits for any number of threads.
#include <algorithm>
#include <memory>

#include "parallel.h"
#include "score_kernels.h"
#include "tile_stage.h"

namespace SW_ARCH {
namespace {

template <class V>
SW_HD V lane_maximum(const V& x) {
  V most = x;
  for (int i = 0; i < lanes_of<V>; ++i) most = maximum(most, V{} + lane(x, i));
  return most;
}

template <class V>
struct TileScorer {
  using S = Scalar<V>;
  static constexpr int L = lanes_of<V>;
  static constexpr int kPacks = kBlockPixels / L;
  static constexpr int kCheck = 16;  // splats between two looks at which blocks still have a live pixel

  const View<S>& view;
  const Slots<S>& slots;
  const Pairs<S>& pairs;
  const Scores<S>& scores;
  S* sums;

  struct Workspace {
    TileStage<V> stage;
    PixelCentres<S> centres;
    alignas(64) S transmittance[kTilePixels];
    alignas(64) S weight[kMaxScores][kTilePixels];  // of the pixel; of scores that have one
  };

  void operator()(int64_t tile, Workspace& w) const {
    const TileFrame frame(view, tile);
    const int64_t begin = pairs.tile_start[tile], end = pairs.tile_start[tile + 1];
    if (begin == end) return;
    w.centres.set(frame);
    std::fill_n(w.transmittance, kTilePixels, S(-1));  // outside the image: done
    frame.for_each_pixel([&](int i, int, int) { w.transmittance[i] = S(1); });
    load_weights(frame, w);
    for (int64_t first = begin; first < end; first += kStage) {
      const int count = int(std::min<int64_t>(kStage, end - first));
      w.stage.load_splats(slots, pairs.slot + first, count, end - first);
      w.stage.find_blocks(frame, count);
      unsigned live = 0;
      for (int k = 0; k < count; ++k) {
        if (k % kCheck == 0) {
          live = live_blocks(w);
          if (live == 0) {
            for (int64_t i = first + k; i < end; ++i) std::fill_n(row(i), scores.count, S(0));
            return;
          }
        }
        score_splat(w, k, unsigned(w.stage.blocks[k]) & live, row(first + k));
      }
    }
  }

  S* row(int64_t pair) const { return sums + int64_t(pairs.origin[pair]) * scores.count; }

  void load_weights(const TileFrame& frame, Workspace& w) const {
    for (int s = 0; s < scores.count; ++s) {
      const S* from = scores.of[s].weight;
      if (from == nullptr) continue;
      std::fill_n(w.weight[s], kTilePixels, S(0));
      frame.for_each_pixel([&](int i, int x, int y) {
        w.weight[s][i] = from[int64_t(frame.y0 + y) * view.width + frame.x0 + x];
      });
    }
  }

  static unsigned live_blocks(const Workspace& w) {
    unsigned live = 0;
    for (int b = 0; b < kBlocks; ++b) {
      bool found = false;
      for (int pack = 0; pack < kPacks; ++pack)
        found |= any(load<V>(w.transmittance + b * kBlockPixels + pack * L) > constant<V>(0));
      live |= unsigned(found) << b;
    }
    return live;
  }

  void score_splat(Workspace& w, int k, unsigned mask, S* out) const {
    V total[kMaxScores];
    // Weights may be negative: so may the maximum be, but not below 0, which a splat that is not drawn has.
    for (int s = 0; s < scores.count; ++s) total[s] = constant<V>(0);
    for (; mask != 0; mask &= mask - 1)
      for (int pack = 0; pack < kPacks; ++pack)
        score_pack(w, k, __builtin_ctz(mask) * kBlockPixels + pack * L, total);
    for (int s = 0; s < scores.count; ++s)
      out[s] = scores.of[s].kind == kBlendMax ? lane(lane_maximum(total[s]), 0) : horizontal_sum(total[s]);
  }

  SW_HD void score_pack(Workspace& w, int k, int at, V* total) const {
    const auto& field = w.stage.field;
    const V zero = constant<V>(0), one = constant<V>(1), ceiling = constant<V>(kAlphaMax);
    const V dx = field[kU][k] - load<V>(w.centres.x + at), dy = field[kV][k] - load<V>(w.centres.y + at);
    const V power = log2_alpha<V>(dx, dy, V{} + field[kA][k], V{} + field[kB][k], V{} + field[kC][k],
                                  V{} + field[kLevel][k]);
    const auto touched = power >= constant<V>(kLog2AlphaMin);
    const V alpha = select(touched, minimum(ceiling, exp_2(power)), zero);
    const V before = load<V>(w.transmittance + at);
    V after = before;
    const V weight = composite(alpha, after);
    store(w.transmittance + at, after);

    const auto tried = touched & (before > zero);
    const V blended = select(weight > zero, one, zero), tested = select(tried, one, zero);
    for (int s = 0; s < scores.count; ++s) {
      const auto& score = scores.of[s];
      const V counted = score.tested ? tested : blended;
      V value = counted;  // hits, opacity
      switch (score.kind) {
        case kOpacityT:
          value = counted * before;
          break;
        case kBlend:
        case kBlendMax:
          value = counted * (alpha * before);
          break;
        case kBlendSq:
          value = counted * (alpha * before) * (alpha * before);
          break;
        case kShown:
          value = select(alpha * before > constant<V>(kShownMin), counted, zero);
          break;
        case kGamma: {
          const V two = constant<V>(2), g = V{} + score.gamma;
          const V log_alpha = log_2(select(tried, alpha, one)), log_t = log_2(select(tried, before, one));
          value = counted * exp_2(two * (g * log_alpha + (one - g) * log_t));
          break;
        }
        case kDist:
          value = counted * square_root(dx * dx + dy * dy);
          break;
        default:
          break;
      }
      if (score.weight != nullptr) value *= load<V>(w.weight[s] + at);
      total[s] = score.kind == kBlendMax ? maximum(total[s], value) : total[s] + value;
    }
  }
};

template <class V>
void score_tiles(const View<Scalar<V>>& view, const Settings& settings, const Slots<Scalar<V>>& slots,
                 const Pairs<Scalar<V>>& pairs, const Scores<Scalar<V>>& scores, Scalar<V>* sums) {
  const TileScorer<V> scorer{view, slots, pairs, scores, sums};
  const int64_t tiles = int64_t(view.tiles_x()) * view.tiles_y();
  const std::vector<int32_t> order = tiles_by_work(pairs.tile_start, tiles);
  std::atomic<int64_t> next{0};
  parallel(settings.parallel, [&] {
    const auto w = std::make_unique<typename TileScorer<V>::Workspace>();
    for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < tiles;) scorer(order[size_t(i)], *w);
  });
}

}  // namespace

template <class S>
void add_scores(int64_t count, const Settings& settings, const Slots<S>& slots, const Scores<S>& scores, const S* sums,
                double* const* totals) {
  parallel_dynamic(settings.parallel, (count + kChunk - 1) / kChunk, [&](int64_t chunk) {
    for (int64_t slot = chunk * kChunk, end = slot + slots.per_chunk[chunk]; slot < end; ++slot) {
      const PairRun run = slots.run[slot];
      const S* rows = sums + int64_t(run.first) * scores.count;
      const double opacity = exp_2(slots.records[slot * kRecord + kLevel]);
      for (int s = 0; s < scores.count; ++s) {
        const int kind = scores.of[s].kind;
        double& total = totals[s][slots.index[slot]];
        double sum = 0;
        for (int32_t i = 0; i < run.count; ++i) {
          const double value = double(rows[int64_t(i) * scores.count + s]);
          sum = kind == kBlendMax ? std::max(sum, value) : sum + value;
        }
        if (kind == kOpacity || kind == kOpacityT) sum *= opacity;
        if (kind == kGradSq) sum *= opacity * opacity;
        total = kind == kBlendMax ? std::max(total, sum) : total + sum;
      }
    }
  });
}

#define SW_INSTANTIATE(S, V)                                                                                       \
  template <>                                                                                                      \
  void score_pairs<S>(const View<S>& view, const Settings& settings, const Slots<S>& slots, const Pairs<S>& pairs, \
                      const Scores<S>& scores, S* sums) {                                                          \
    score_tiles<V>(view, settings, slots, pairs, scores, sums);                                                    \
  }                                                                                                                \
  template void add_scores<S>(int64_t, const Settings&, const Slots<S>&, const Scores<S>&, const S*, double* const*);
SW_INSTANTIATE(float, Lanes)
SW_INSTANTIATE(double, double)
#undef SW_INSTANTIATE

}  // namespace SW_ARCH
