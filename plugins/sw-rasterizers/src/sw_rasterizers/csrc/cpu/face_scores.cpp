// Scores and Fisher blocks from the lists of a view; the work is done in scores.cpp and fisher.cpp.
#include "score_kernels.h"
#include "face.h"
#include "face_state.h"

namespace {

using namespace sw;  // NOLINT: one file

template <class Call>
void check_colors(const Call& call) {
  if (call.color_channels != 3)
    refuse("grad_sq, removal and Fisher blocks need 3 colour channels, got %lld", (long long)call.color_channels);
}

template <class S>
void scores(const add_scores_call& call, const Parallel& parallel) {
  const auto view = view_of<S>(call);
  const auto settings = settings_of(call.flags, parallel);
  const auto splats = Splats<S>::of(call, call.channels, 0);
  const auto lists = Lists<S>::of(call, view);
  if (call.scores < 1 || call.scores > kMaxScores)
    refuse("1 to %d scores are formed at once, got %lld", kMaxScores, (long long)call.scores);
  if (!(call.flags & kSave)) refuse("scores need lists that were made with kSave");
  const bool sensitive = is_sensitive(int(call.kinds[0]));
  Scores<S> asked;
  for (int i = 0; i < call.scores; ++i) {
    const int64_t kind = call.kinds[i];
    if (kind < kHits || kind > kRemoval || is_sensitive(int(kind)) != sensitive || call.totals[i] == nullptr)
      refuse("score %d is malformed", i);
    asked.of[asked.count++] = {int(kind), call.tested[i] != 0, S(call.gammas[i]), numbers<S>(call.weights[i])};
  }
  S* const sums = numbers<S>(call.sums);
  if (sensitive) {
    check_colors(call);
    SW_SELECT(sensitivity_pairs<S>)(view, settings, splats.slots, lists.pairs, lists.canvas(call), {false, &asked}, sums);
  } else {
    SW_SELECT(score_pairs<S>)(view, settings, splats.slots, lists.pairs, asked, sums);
  }
  SW_SELECT(add_scores<S>)(call.count, settings, splats.slots, asked, sums, call.totals);
}

template <class S>
void fisher(const add_fisher_call& call, const Parallel& parallel) {
  const auto view = view_of<S>(call);
  const auto settings = settings_of(call, parallel);
  const auto splats = Splats<S>::of(call, call.channels, call.sh_degree);
  const auto lists = Lists<S>::of(call, view);
  check_colors(call);
  if ((call.flags & (kSave | kForScores | kAntialias)) != kSave)
    refuse("Fisher blocks need lists that were made with kSave, and no antialiasing");
  Gaussians<S> g;
  g.count = g.shapes = call.count;
  g.means = numbers<S>(call.means), g.scales = numbers<S>(call.scales), g.quats = numbers<S>(call.quats);
  S* const sums = numbers<S>(call.sums);
  SW_SELECT(sensitivity_pairs<S>)(view, settings, splats.slots, lists.pairs, lists.canvas(call), {true, nullptr}, sums);
  SW_SELECT(add_fisher<S>)(view, g, settings, splats.slots, sums, call.blocks);
}

}  // namespace

SW_OPERATION(sw_rasterizers, add_scores) {
  return with_numbers(call, [&](auto number, const Parallel& parallel) { scores<decltype(number)>(*call, parallel); });
}

SW_OPERATION(sw_rasterizers, add_fisher) {
  return with_numbers(call, [&](auto number, const Parallel& parallel) { fisher<decltype(number)>(*call, parallel); });
}
