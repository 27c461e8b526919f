// Scores and Fisher blocks from the lists of a view; the work is done in scores.cu and fisher.cu.
#include "face.h"

#include "face_state.h"

namespace {

using namespace sw;        // NOLINT: one file
using namespace sw::cuda;  // NOLINT

template <class Call>
void check_colors(const Call& call) {
  if (call.color_channels != 3)
    refuse("grad_sq, removal and Fisher blocks need 3 colour channels, got %lld", (long long)call.color_channels);
}

void scores(const accumulate_scores_call& call, cudaStream_t stream) {
  check_floats(call);
  const auto view = view_of<float>(call);
  const ListMemory kept = ListMemory::of(call, view, Way(view, call.channels, call.color_channels, call.flags));
  if (call.scores < 0 || call.scores > kMaxScores)
    refuse("at most %d scores are formed at once, got %lld", kMaxScores, (long long)call.scores);
  // Those of one family, and where each is added to.
  Totals to[2]{};
  Scores<float> of[2];
  for (int i = 0; i < call.scores; ++i) {
    const int kind = int(call.kinds[i]);
    if (kind < kHits || kind > kRemoval || (call.totals[i] == nullptr && call.count > 0)) refuse("score %d is malformed", i);
    const int family = is_sensitive(kind);
    if (family == 1) check_colors(call);
    to[family].of[of[family].count] = call.totals[i];
    of[family].of[of[family].count++] = {kind, call.tested[i] != 0, float(call.gammas[i]), call.weights[i]};
  }
  if (call.pairs == 0) return;
  const TileLists lists{kept.tile_start, call.pair_splats};
  const Ordered ordered = ordered_of(call, kScoreParts, nullptr, 0, stream);
  if (of[0].count > 0) score_pixels(view, kept.splats, lists, of[0], to[0], ordered, stream);
  if (of[1].count > 0)
    sensitivity_scores(view, call.flags & kPassClamp, kept.splats, lists, kept.image(call, tiles_of(view), 0), of[1],
                       to[1], ordered, stream);
}

void fisher(const accumulate_fisher_call& call, cudaStream_t stream) {
  check_floats(call), check_colors(call);
  const auto view = view_of<float>(call);
  const auto g = gaussians_of<float>(call);
  const ListMemory kept = ListMemory::of(call, view, Way(view, call.channels, call.color_channels, call.flags));
  if (call.scales == nullptr || (call.flags & kAntialias)) refuse("Fisher blocks need scales and no antialiasing");
  if (call.splats < call.used) refuse("rows of %lld splats of %lld", (long long)call.splats, (long long)call.used);
  if (call.pairs == 0) return;
  const Ordered ordered = ordered_of(call, kFisherParts * kFisherSums, nullptr, 0, stream);
  fisher_sums(view, call.flags & kPassClamp, kept.splats, {kept.tile_start, call.pair_splats},
              kept.image(call, tiles_of(view), 0), call.rows, ordered, stream);
  fisher_blocks(view, g, settings_of(call, nullptr), int(call.used), kept.splats, call.drawn, call.rows, call.blocks,
                stream);
}

}  // namespace

SW_OPERATION(sw_rasterizers_cuda, accumulate_scores) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) { scores(*call, stream); });
}

SW_OPERATION(sw_rasterizers_cuda, accumulate_fisher) {
  return guarded_on_gpu(call, [&](cudaStream_t stream) { fisher(*call, stream); });
}
