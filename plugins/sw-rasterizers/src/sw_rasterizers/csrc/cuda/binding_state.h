// What `render` keeps on CUDA: for blend_backward, and for the scores, which walk the same lists.
#pragma once

namespace sw::cuda {

// clang-format off
enum Saved {  // the flags of the Gaussians, for project_backward, come behind what blend_backward needs
  kShape, kChannelRows, kTileStart, kSplat, kTransmittance, kLast, kMedianSplat, kBehind, kWhere, kSavedCount,
  kFlags = kSavedCount
};
// clang-format on

}  // namespace sw::cuda
