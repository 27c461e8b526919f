// The CPU kernels of scores and Fisher blocks; they take the slots and pairs that the standard kernels make.
//
//   score_pairs         lists -> one row of sums per (splat, tile) pair, front to back
//   sensitivity_pairs   the same of what depends on the light behind a splat, back to front, after `blend`
//   add_scores          rows -> totals of the Gaussians
//   add_fisher          rows -> Fisher blocks of the Gaussians
#pragma once

#include "../scores.h"
#include "kernels.h"

namespace sw {

// What sensitivity_pairs adds up: the Fisher sums, or for every score (dL/dalpha)^2 or the change by removal.
template <class S>
struct Sensitivity {
  bool fisher;
  const Scores<S>* scores;
  int columns() const { return fisher ? int(kFisherSums) : scores->count; }
};

}  // namespace sw

// sums [P][columns], splat-major. totals [scores][N] and blocks [N][kFisher] are added to.
#define SW_DECLARE_KERNELS(arch)                                                                                       \
  namespace arch {                                                                                                     \
  template <class S>                                                                                                   \
  void score_pairs(const View<S>& view, const Settings& settings, const Slots<S>& slots, const Pairs<S>& pairs,        \
                   const Scores<S>& scores, S* sums);                                                                  \
  template <class S>                                                                                                   \
  void sensitivity_pairs(const View<S>& view, const Settings& settings, const Slots<S>& slots, const Pairs<S>& pairs,  \
                         const Canvas<S>& canvas, const Sensitivity<S>& what, S* sums);                                \
  template <class S>                                                                                                   \
  void add_scores(int64_t count, const Settings& settings, const Slots<S>& slots, const Scores<S>& scores,             \
                  const S* sums, double* const* totals);                                                               \
  template <class S>                                                                                                   \
  void add_fisher(const View<S>& view, const Gaussians<S>& g, const Settings& settings, const Slots<S>& slots,         \
                  const S* sums, double* blocks);                                                                      \
  }
SW_FOR_EACH_ARCH(SW_DECLARE_KERNELS)
#undef SW_DECLARE_KERNELS
