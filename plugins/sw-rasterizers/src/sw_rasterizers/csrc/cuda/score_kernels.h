// The CUDA kernels of scores and Fisher blocks; they take the lists and the pixels that `render` leaves.
//
//   score_pixels         lists -> totals of the Gaussians, front to back
//   sensitivity_scores   the same of (o dL/dalpha)^2 and of changes by removal, back to front
//   fisher_sums          lists -> a row of sums for every splat, back to front
//   fisher_blocks        rows -> Fisher blocks of the Gaussians
#pragma once

#include "../scores.h"
#include "kernels.h"

namespace sw::cuda {

struct Totals {
  double* of[kMaxScores];  // [N] each, added to
};

// Floats a pair that `Ordered::pair_sums` must have: a part for each warp of a tile's block.
constexpr int kScoreParts = 8, kFisherParts = 4;

void score_pixels(const View<float>& view, const Splats& splats, const TileLists& lists, const Scores<float>& scores,
                  const Totals& totals, const Ordered& ordered, cudaStream_t stream);
void sensitivity_scores(const View<float>& view, bool pass_clamp, const Splats& splats, const TileLists& lists,
                        const Image& image, const Scores<float>& scores, const Totals& totals, const Ordered& ordered,
                        cudaStream_t stream);
// rows [splats][kFisherSums], zeros before.
void fisher_sums(const View<float>& view, bool pass_clamp, const Splats& splats, const TileLists& lists,
                 const Image& image, float* rows, const Ordered& ordered, cudaStream_t stream);
// `flags` of the Gaussians as `render` leaves them; blocks [N][kFisher] are added to.
void fisher_blocks(const View<float>& view, const Gaussians<float>& g, const Settings& settings, int count,
                   const Splats& splats, const uint8_t* flags, const float* rows, double* blocks, cudaStream_t stream);

}  // namespace sw::cuda
