// The arguments of the CUDA op of the scores, checked.
#pragma once

#include "binding.h"
#include "../scores.h"

namespace sw {

// How the scores of one call are asked for, and where they are added to; see the op `accumulate_scores`.
struct ScoreInputs {
  at::ArrayRef<int64_t> kinds, rules, weight_rows;
  at::ArrayRef<double> gammas;
  const OptionalTensor& weights;
  const Tensor& totals;
  const OptionalTensor& blocks;

  void check(const Inputs& in, at::ArrayRef<double> camera, int64_t width, int64_t height) const {
    in.check();
    TORCH_CHECK(camera.size() == 18 && width > 0 && height > 0, "sw_rasterizers: malformed camera");
    const int64_t n = in.means.size(0), count = int64_t(kinds.size());
    TORCH_CHECK(count <= kMaxScores, "sw_rasterizers: at most ", kMaxScores, " scores in one call, got ", count);
    TORCH_CHECK(int64_t(rules.size()) == count && int64_t(gammas.size()) == count &&
                    int64_t(weight_rows.size()) == count,
                "sw_rasterizers: kinds, rules, gammas and weight_rows must be equally long");
    in.check_shape("weights", weights, {-1, height, width});
    in.check_shape("totals", totals, {count, n});
    in.check_shape("blocks", blocks, {n, kFisher});
    TORCH_CHECK(!weights.has_value() || weights->scalar_type() == in.means.scalar_type(),
                "sw_rasterizers: weights must have the dtype of means");
    TORCH_CHECK(totals.scalar_type() == at::kDouble && (!blocks.has_value() || blocks->scalar_type() == at::kDouble),
                "sw_rasterizers: totals and blocks must be float64");
    const int64_t maps = weights.has_value() ? weights->size(0) : 0;
    for (int64_t s = 0; s < count; ++s)
      TORCH_CHECK(kinds[s] >= kHits && kinds[s] <= kRemoval && weight_rows[s] >= -1 &&
                      weight_rows[s] + (kinds[s] == kRemoval && weight_rows[s] >= 0 ? 3 : 1) <= maps,
                  "sw_rasterizers: score ", s, " is malformed");
    TORCH_CHECK(!wants_sensitivity() || in.channels().colors == 3,
                "sw_rasterizers: grad_sq, removal and Fisher blocks need 3 colour channels, got ", in.channels().colors);
    TORCH_CHECK(!blocks.has_value() || (in.scales.has_value() && !(in.flags & kAntialias)),
                "sw_rasterizers: Fisher blocks need scales and no antialiasing");
    TORCH_CHECK(!in.background.has_value() || in.background->device() == in.means.device(),
                "sw_rasterizers: background is on ", in.background->device(), ", means on ", in.means.device());
  }

  bool wants_sensitivity() const {
    bool found = blocks.has_value();
    for (const int64_t kind : kinds) found |= is_sensitive(int(kind));
    return found;
  }

  // Those of one family, and where each is added to.
  template <class S>
  Scores<S> select(bool sensitive, double** to) const {
    Scores<S> out;
    for (size_t s = 0; s < kinds.size(); ++s) {
      if (is_sensitive(int(kinds[s])) != sensitive) continue;
      const S* map = nullptr;
      if (weight_rows[s] >= 0) map = data<S>(weights) + weight_rows[s] * weights->size(1) * weights->size(2);
      to[out.count] = data<double>(totals) + int64_t(s) * totals.size(1);
      out.of[out.count++] = {int(kinds[s]), rules[s] != 0, S(gammas[s]), map};
    }
    return out;
  }
};

}  // namespace sw
